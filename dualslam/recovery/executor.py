"""What runs reverse tracking: here in the process that tracks, or in processes beside it (`dualslam/workers`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from dualslam.core.types import Failure
from dualslam.recovery.job import RecoveryJob, RecoveryResult
from dualslam.recovery.reverse_tracking import RecoveryParts, run_recovery
from dualslam.recovery.walk_news import WalkNews
from dualslam.workers.jobs import Desk, JobKind

Outcome = tuple[RecoveryJob, RecoveryResult | Failure]


class RecoveryExecutor(Protocol):
    """Runs jobs, somewhere: the system neither knows where nor waits for them."""

    def submit(self, job: RecoveryJob) -> None:
        """Take a job on."""
        ...

    def poll(self) -> list[Outcome]:
        """Return what has ended since the last call."""
        ...

    def finish(self) -> list[Outcome]:
        """Take no more jobs, and return the outcomes of all that are left."""
        ...


class InlineExecutor:
    """Runs each job when it is submitted: one process, deterministic.

    Parameters
    ----------
    parts : RecoveryParts
    tell : callable, optional
        Called, during a walk, with how far it has come.
    """

    def __init__(self, parts: RecoveryParts, tell: Callable[[WalkNews], None] | None = None) -> None:
        self._parts, self._tell = parts, tell
        self._done: list[Outcome] = []

    def submit(self, job: RecoveryJob) -> None:
        """Run the job."""
        self._done.append((job, run_recovery(job, self._parts, self._tell)))

    def poll(self) -> list[Outcome]:
        """Return what has run since the last call."""
        done, self._done = self._done, []
        return done

    def finish(self) -> list[Outcome]:
        """Return what has run since the last call."""
        return self.poll()


class DeskExecutor:
    """Runs each job at a desk, beside the tracking."""

    def __init__(self, desk: Desk) -> None:
        self.desk = desk

    def submit(self, job: RecoveryJob) -> None:
        """Hand the job to the desk."""
        self.desk.submit(JobKind.WALK, job)

    def poll(self) -> list[Outcome]:
        """Return what has ended since the last call."""
        return [(ended.work, ended.result) for ended in self.desk.poll(JobKind.WALK)]

    def finish(self) -> list[Outcome]:
        """Wait for what is under way, for so long and no longer."""
        return [(ended.work, ended.result) for ended in self.desk.drain(JobKind.WALK)]
