"""Work beside the tracking: one mechanism for all that the next frame does not need.

A job is a snapshot of arrays that nobody else changes, and its kind says what is made of it. What comes back is a
change, which the part that asked for it merges, between two frames, into a map that has grown meanwhile. The desk
decides where the work is done: `InlineDesk` does it at once, in the process that tracks, so that the same seed gives
the same run to the bit; `dualslam/workers/desk.py` has the one with processes. A job may fail: then its outcome is a
`Failure`, and nothing else has changed.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Protocol, TypeVar

from dualslam.core.types import Failure

Result = TypeVar("Result")


class JobKind(StrEnum):
    """What is made of a snapshot, the most urgent first."""

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

One that is a generator function yields how far it has come, for those who look on, and returns its result."""
Handlers = Mapping[JobKind, Handler]


def result_of(work: Generator[Any, None, Result], tell: Callable[[Any], None] | None) -> Result:
    """Do work that yields how far it has come, tell that, and return what comes of it."""
    while True:
        try:
            news = next(work)
        except StopIteration as end:
            result: Result = end.value
            return result
        if tell is not None:
            tell(news)


@dataclass(frozen=True, slots=True, eq=False)
class Ended:
    """A job that has come to its end.

    Attributes
    ----------
    work : object
        As it was submitted.
    result : object or Failure
    cpu_s : float
        CPU time of the process that did it; 0 inline, where the caller's own clock has run.
    wall_s : float
        From when it was submitted, the time in the queue included; 0 inline.
    """

    work: Any
    result: Any | Failure
    cpu_s: float = 0.0
    wall_s: float = 0.0


class Desk(Protocol):
    """Takes work on and gives results out: nobody waits for anything before the run ends."""

    def submit(self, kind: JobKind, work: Any, of: int | None = None) -> None:
        """Take a job on; one too many ends at once, as a `Failure`.

        `of`: the submap without which the answer is of no use.
        """
        ...

    def poll(self, kind: JobKind) -> list[Ended]:
        """Return what has ended of a kind since the last call, in the order in which it ended; never wait."""
        ...

    def n_open(self, kind: JobKind, of: int | None = None) -> int:
        """Count the jobs of a kind that wait or run; `of`: those that are of use to this submap alone."""
        ...

    def withdraw(self, of: int) -> None:
        """Drop the jobs that wait and are of use to this submap alone: it is no longer live."""
        ...

    def drain(self, kind: JobKind) -> list[Ended]:
        """Wait, for a limited time, for the jobs of a kind that are under way, and return their outcomes."""
        ...

    def close(self) -> None:
        """End the processes, and what they do."""
        ...


PAUSE_S = 1e-3
"""Between two looks at whether a job has ended, where a run waits for it."""


def awaited(desk: Desk, kind: JobKind) -> Iterator[Ended]:
    """Wait for all jobs of a kind, as a run does that has no clock to keep up with, and yield each as it ends."""
    while desk.n_open(kind):
        ended = desk.poll(kind)
        yield from ended
        if not ended:
            time.sleep(PAUSE_S)


class InlineDesk:
    """Does each job when it is submitted: one process, deterministic.

    Parameters
    ----------
    handlers : mapping of JobKind to Handler
    """

    def __init__(self, handlers: Handlers) -> None:
        self._handlers = handlers
        self._done: defaultdict[JobKind, list[Ended]] = defaultdict(list)

    def submit(self, kind: JobKind, work: Any, of: int | None = None) -> None:
        """Do the job."""
        self._done[kind].append(Ended(work, self._handlers[kind](work)))

    def poll(self, kind: JobKind) -> list[Ended]:
        """Return what was done since the last call."""
        return self._done.pop(kind, [])

    def n_open(self, kind: JobKind, of: int | None = None) -> int:
        """Return 0."""
        return 0

    def withdraw(self, of: int) -> None:
        """Do nothing: no job waits."""

    def drain(self, kind: JobKind) -> list[Ended]:
        """Return what was done since the last call."""
        return self.poll(kind)

    def close(self) -> None:
        """Do nothing."""
