"""An executor that loses jobs, as workers do that die: for schedules that are simulated."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from typing import Any

from dualslam.core.jobs import Ended, Executor, JobKind, Limit
from dualslam.core.types import Failure, FailureReason


class Lossy:
    """Loses one of so many jobs of some kinds, and what their handlers keep from job to job.

    Parameters
    ----------
    kinds : collection of JobKind
    every : int
    seed : int
        Says which of them.
    reason : FailureReason
        `WORKER`: the process died; `TIMEOUT`: it hung.
    """

    def __init__(
        self, kinds: Collection[JobKind], every: int, seed: int = 0, reason: FailureReason = FailureReason.WORKER
    ) -> None:
        self._kinds, self._every, self._seed, self._reason = kinds, every, seed, reason
        self._n: Counter[JobKind] = Counter()
        self.n_lost = 0

    def around(self, inner: Executor) -> LossyExecutor:
        """Return the executor that loses jobs."""
        return LossyExecutor(inner, self)

    def loses(self, kind: JobKind) -> bool:
        """Count a job; return whether it is lost."""
        self._n[kind] += 1
        lost = kind in self._kinds and (self._n[kind] + self._seed) % self._every == 0
        self.n_lost += lost
        return lost

    def failure(self) -> Failure:
        """Return what a lost job ends with."""
        return Failure(self._reason, "the job was lost on purpose")


class LossyExecutor:
    """See `Lossy`."""

    def __init__(self, inner: Executor, script: Lossy) -> None:
        self._inner, self._script = inner, script
        self._lost: dict[JobKind, list[Ended]] = {}

    def submit(self, kind: JobKind, work: Any, of: int | None = None, limit: Limit | None = None) -> None:
        """Do a job, or lose it."""
        if self._script.loses(kind):
            self._inner.lose(kind)
            self._lost.setdefault(kind, []).append(Ended(work, self._script.failure()))
        else:
            self._inner.submit(kind, work, of, limit)

    def poll(self, kind: JobKind) -> list[Ended]:
        """Return what has ended, lost jobs first."""
        return self._lost.pop(kind, []) + self._inner.poll(kind)

    def withdraw(self, of: int) -> None:
        """Withdraw them."""
        self._inner.withdraw(of)

    def drain(self, kind: JobKind, wait_s: float | None = None) -> list[Ended]:
        """Return what has ended."""
        return self._lost.pop(kind, []) + self._inner.drain(kind, wait_s)

    def lose(self, kind: JobKind) -> None:
        """Lose what the handler keeps."""
        self._inner.lose(kind)

    def close(self) -> None:
        """Close the executor within."""
        self._inner.close()
