"""Reverse tracking of a system under test, taken in hand: kept, watched, delayed or lost."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from dualslam.core.jobs import Desk, Ended, JobKind
from dualslam.core.types import Failure
from dualslam.recovery.job import RecoveryJob, RecoveryResult
from dualslam.system.system import System

Outcome = tuple[RecoveryJob, RecoveryResult | Failure]


class Walks(Protocol):
    """Runs walks, somewhere."""

    def submit(self, job: RecoveryJob) -> None:
        """Take a job on."""
        ...

    def poll(self) -> list[Outcome]:
        """Return what has ended since the last call."""
        ...

    def finish(self) -> list[Outcome]:
        """Return the outcomes of all that are left, each once."""
        ...


AnyWalks = TypeVar("AnyWalks", bound=Walks)


class WalksAt:
    """Those of a desk."""

    def __init__(self, desk: Desk) -> None:
        self.desk = desk

    def submit(self, job: RecoveryJob) -> None:
        """Hand the job to the desk."""
        self.desk.submit(JobKind.WALK, job)

    def poll(self) -> list[Outcome]:
        """Return what has ended since the last call."""
        return [(ended.work, ended.result) for ended in self.desk.poll(JobKind.WALK)]

    def finish(self) -> list[Outcome]:
        """Wait for what is under way."""
        return [(ended.work, ended.result) for ended in self.desk.drain(JobKind.WALK)]


class KeptWalks:
    """Keeps the jobs; nothing comes of them."""

    def __init__(self) -> None:
        self.jobs: list[RecoveryJob] = []

    def submit(self, job: RecoveryJob) -> None:
        """Keep the job."""
        self.jobs.append(job)

    def poll(self) -> list[Outcome]:
        """Return nothing."""
        return []

    finish = poll


class WatchedWalks:
    """Notes the jobs that it hands on."""

    def __init__(self, inner: Walks) -> None:
        self.inner = inner
        self.jobs: list[RecoveryJob] = []

    def submit(self, job: RecoveryJob) -> None:
        """Note the job."""
        self.jobs.append(job)
        self.inner.submit(job)

    def poll(self) -> list[Outcome]:
        """Return what has ended since the last call."""
        return self.inner.poll()

    def finish(self) -> list[Outcome]:
        """Return the outcomes of all that are left."""
        return self.inner.finish()


class _WalkDesk:
    """The desk that the system's recoveries see."""

    def __init__(self, walks: Walks) -> None:
        self._walks = walks

    def submit(self, kind: JobKind, work: Any, of: int | None = None) -> None:
        self._walks.submit(work)

    def poll(self, kind: JobKind) -> list[Ended]:
        return [Ended(*outcome) for outcome in self._walks.poll()] if kind is JobKind.WALK else []

    def drain(self, kind: JobKind) -> list[Ended]:
        return [Ended(*outcome) for outcome in self._walks.finish()] if kind is JobKind.WALK else []


def replace_walks(system: System, wrap: Callable[[Walks], AnyWalks]) -> AnyWalks:
    """Let a system's walks be run by what `wrap` makes of those of its desk; return that."""
    walks = wrap(WalksAt(system._recoveries._desk))
    system._recoveries._desk = _WalkDesk(walks)  # type: ignore[assignment]  # nothing else is asked of it
    return walks
