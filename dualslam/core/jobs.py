"""Background work: one mechanism for all that the next frame does not need.

A job is a snapshot of arrays that nobody else changes, and its kind says what is made of it. The result is a change.
The part that asked for it merges it, between two frames, into a map that has grown meanwhile. An executor does the
work: `InlineDesk` at once, in the process that tracks, `WorkerDesk` (`dualslam/workers/desk.py`) in others. The
schedule (`dualslam/core/schedule.py`) says when the results are used: the same one gives the same run to the bit. A job
may fail: then its outcome is a `Failure`, and nothing else has changed.
"""

from __future__ import annotations

import pickle
import time
from collections import defaultdict
from collections.abc import Callable, Container, Generator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Protocol, TypeVar

from dualslam.core.types import Failure, FailureReason

Result = TypeVar("Result")


class JobKind(StrEnum):
    """Kinds of jobs, the most urgent first."""

    FEATURES = "features"
    START = "start search"
    GRAPH = "graph"
    EDGES = "edge covariances"
    ATLAS = "atlas"
    SCALE = "scale watch"
    READOUT = "readout"
    CALIBRATION = "calibration"
    LOOP = "loop search"
    WALK = "walk back"
    FORESIGHT = "foresight"


Handler = Callable[[Any], Any]
"""Makes a result, which can be pickled, or a `Failure` of the work. One that keeps a state is asked in order.

One that is a generator function yields at each step: how far it has come, for those who look on, or None. It is sent
whether its time is over, and returns its result."""
Handlers = Mapping[JobKind, Handler]


@dataclass(slots=True)
class Limit:
    """The limit after which a job that works in steps must stop; by default none."""

    after_s: float | None = None  # wall time
    after_steps: int | None = None  # steps: the same on every machine
    steps: int | None = None  # after which it was stopped

    def is_over(self, n_steps: int, seconds: float) -> bool:
        """Return whether the time is over, and note when it was for the first time."""
        if self.steps is None and (
            (self.after_s is not None and seconds > self.after_s)
            or (self.after_steps is not None and n_steps >= self.after_steps)
        ):
            self.steps = n_steps
        return self.steps is not None


def result_of(
    work: Generator[Any, bool | None, Result], tell: Callable[[Any], None] | None = None, limit: Limit | None = None
) -> Result:
    """Do work in steps, report how far it has come, and return its result."""
    began_s, n_steps, is_over = time.monotonic(), 0, None
    while True:
        try:
            news = work.send(is_over)
        except StopIteration as end:
            result: Result = end.value
            return result
        if tell is not None and news is not None:
            tell(news)
        is_over = limit is not None and limit.is_over(n_steps, time.monotonic() - began_s)
        n_steps += 1


@dataclass(frozen=True, slots=True, eq=False)
class Ended:
    """A job that has come to its end."""

    work: Any  # as it was submitted
    result: Any | Failure
    cpu_s: float = 0.0  # CPU time of the process that did it; 0 inline, where the caller's own clock has run
    wall_s: float = 0.0  # from when it was submitted, the time in the queue included; 0 inline
    stopped_after: int | None = None  # steps after which it was stopped early


class Desk(Protocol):
    """Takes work on and gives results out, when its schedule says so."""

    def submit(self, kind: JobKind, work: Any, of: int | None = None) -> None:
        """Take a job on, of use as long as submap `of` is; one too many ends at once, as a `Failure`."""
        ...

    def poll(self, kind: JobKind) -> list[Ended]:
        """Return what has been given out of a kind since the last call."""
        ...

    def n_open(self, kind: JobKind, of: int | None = None) -> int:
        """Count the jobs of a kind whose results are still to come; `of`: that are of use to this submap alone."""
        ...

    def withdraw(self, of: int) -> None:
        """Drop the jobs that are of use to this submap alone: it is no longer live."""
        ...

    def drain(self, kind: JobKind) -> list[Ended]:
        """Wait for the open jobs of a kind, for a limited time where there is a clock, and return their outcomes."""
        ...

    def close(self) -> None:
        """End the processes, and what they do."""
        ...


class Executor(Protocol):
    """Does the jobs of a desk, in this process or in others, and knows nothing of frames."""

    def submit(self, kind: JobKind, work: Any, of: int | None = None, limit: Limit | None = None) -> None:
        """Take a job on."""
        ...

    def poll(self, kind: JobKind) -> list[Ended]:
        """Return what has ended of a kind since the last call; never wait."""
        ...

    def withdraw(self, of: int) -> None:
        """Drop the jobs that have not begun and are of use to this submap alone."""
        ...

    def drain(self, kind: JobKind, wait_s: float | None = None) -> list[Ended]:
        """Wait so long for the jobs of a kind; those that have not ended by then are lost, and end as a `Failure`."""
        ...

    def lose(self, kind: JobKind) -> None:
        """Forget what the handler of a kind keeps from job to job, as a process that has ended does."""
        ...

    def close(self) -> None:
        """End the processes, and what they do."""
        ...


PAUSE_S = 1e-3
"""Between two looks at whether a job has ended, where a run waits for it."""
MAX_WAITING = 8
"""Jobs of a kind that may be open: with more the back end is behind, and they hold their snapshots in memory."""


class InlineDesk:
    """Does each job when it is submitted: one process, deterministic.

    - `handlers`: one that keeps a state from job to job may have a method `forget`.
    - `tell`: called, during a job that works in steps, with how far it has come.
    - `is_lost`: whether a job (its kind and its work) is to end as if its process had died: where the failure lab takes
      hold.
    - `copied`: kinds whose handlers keep what they are given, which is therefore copied, as into another process.
    """

    def __init__(
        self,
        handlers: Handlers,
        tell: Callable[[Any], None] | None = None,
        is_lost: Callable[[JobKind, Any], bool] | None = None,
        copied: Container[JobKind] = (),
    ) -> None:
        self._handlers = handlers
        self._tell = tell
        self._is_lost = is_lost
        self._copied = copied
        self._done: defaultdict[JobKind, list[Ended]] = defaultdict(list)

    def submit(self, kind: JobKind, work: Any, of: int | None = None, limit: Limit | None = None) -> None:
        """Do the job."""
        if self._is_lost is not None and self._is_lost(kind, work):
            lost = Failure(FailureReason.WORKER, "the failure lab takes this job away")
            self._done[kind].append(Ended(work, lost))
            return
        given = pickle.loads(pickle.dumps(work, protocol=5)) if kind in self._copied else work
        result = self._handlers[kind](given)
        if isinstance(result, Generator):
            result = result_of(result, self._tell, limit)
        stopped = None if limit is None else limit.steps
        self._done[kind].append(Ended(work, result, stopped_after=stopped))

    def poll(self, kind: JobKind) -> list[Ended]:
        """Return what was done since the last call."""
        return self._done.pop(kind, [])

    def n_open(self, kind: JobKind, of: int | None = None) -> int:
        """Return 0."""
        return 0

    def withdraw(self, of: int) -> None:
        """Do nothing: no job waits."""

    def drain(self, kind: JobKind, wait_s: float | None = None) -> list[Ended]:
        """Return what was done since the last call."""
        return self.poll(kind)

    def lose(self, kind: JobKind) -> None:
        """Let the handler of a kind forget what it keeps."""
        forget = getattr(self._handlers.get(kind), "forget", None)
        if forget is not None:
            forget()

    def close(self) -> None:
        """Do nothing."""
