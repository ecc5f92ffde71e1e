"""The harness around the algorithm: feeds a system the frames of a sequence, keeps time, and stops when asked to."""

from __future__ import annotations

import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import FrameType
from typing import Any, Protocol

from dualslam.core.errors import InputError
from dualslam.core.interfaces import Sequence
from dualslam.core.types import Frame
from dualslam.io.read_ahead import read_ahead
from dualslam.map.frame_records import FrameResult
from dualslam.pace import Pace

MAX_LATE_S = 1 / 15
"""So late a frame may be while the next one waits: two frames of a camera at 30 Hz, which most often are what a
keyframe takes more than other frames, and are caught up on after it. At 10 Hz a frame that the next one has overtaken
is later."""
CATCH_UP_S = 1.0
"""Who has not been in time for so long does not catch up: the newest frame is then the one to look at."""
PAUSE_S = 0.05
"""Between two looks at whether a run is to go on."""
SWITCH_S = 5e-4
"""How long a thread computes while another waits for its turn, in real time: features would wait 5 ms at each step."""
LATE_S = 2e-3
"""What a sleeping process wakes up too late by is no lateness of ours."""


class Steppable(Protocol):
    """What the harness needs of a system."""

    def step(self, frame: Frame) -> FrameResult:
        """Take one frame."""
        ...

    def finish(self, interrupted: bool = False) -> None:
        """End the run; in a `interrupted` with what there is."""
        ...


@dataclass(frozen=True, slots=True)
class RunReport:
    """What a run cost and how it ended. The map itself stays in the system.

    Attributes
    ----------
    n_frames : int
        Frames that the source gave, those dropped included.
    dropped : tuple of (int, float)
        Index and time of the frames that came too late to be looked at (`realtime`).
    latencies_ms : tuple of float
        Of each frame that was looked at: in real time from the moment when it was due to its pose, what it waited for
        included (to the end of its step, where it has none); else the wall time of its step.
    steps_ms : tuple of float
        Wall time of each step.
    n_late : int
        Frames that the system was ready for only after their time (`realtime`).
    wall_s, cpu_s : float
        From the first frame to the end; user and system time of this process and of the children that have ended.
    peak_rss_mb : float
        Highest resident memory of the process since it started, and of the largest of its children that have ended.
    interrupted : bool
        True where a signal ended the run early.
    error : InputError or None
        What ended the source early.
    bug : Exception or None
        What the system raised, which ended the run: its maker's mistake, no property of the input.
    """

    n_frames: int
    dropped: tuple[tuple[int, float], ...]
    latencies_ms: tuple[float, ...]
    steps_ms: tuple[float, ...]
    n_late: int
    wall_s: float
    cpu_s: float
    peak_rss_mb: float
    interrupted: bool
    error: InputError | None
    bug: Exception | None

    @property
    def fps(self) -> float:
        """Frames a second, dropped ones not counted."""
        return len(self.latencies_ms) / self.wall_s if self.wall_s > 0 else 0.0


def run_sequence(
    system: Steppable,
    sequence: Sequence,
    *,
    realtime: bool = False,
    prepare: Callable[[Frame], Frame] | None = None,
    pace: Pace | None = None,
    on_frame: Callable[[FrameResult], None] | None = None,
    is_paused: Callable[[], bool] | None = None,
    clock: Callable[[], float] = time.perf_counter,
    sleep: Callable[[float], None] = time.sleep,
) -> RunReport:
    """Feed a system all frames of a sequence, then finish it.

    The first SIGINT or SIGTERM ends the run after the frame in hand, so that what there is can be saved; the second one
    acts as ever. A source that breaks after its first frame ends the run in the same way, and so does a system that
    raises; what it raised is in the report, for the caller to raise again once the rest is saved.

    Parameters
    ----------
    system : Steppable
    sequence : Sequence
    realtime : bool
        Frames come at the times that their timestamps tell, and those that are too late are dropped before anything is
        done with them: a frame is, if it is more than `MAX_LATE_S` late when the system is ready for it, and the next
        one is due already. A system that has not been in time for `CATCH_UP_S` is given the newest frame.
    prepare : callable, optional
        In real time: called with a frame, on a thread of its own, while the one before it is in its step; returns what
        the system is given.
    pace : Pace, optional
        Is told, in real time, how late each frame is.
    on_frame : callable, optional
        Called with the result of each step.
    is_paused : callable, optional
        Asked before each frame; the run waits for as long as it says so, or until a signal ends it.
    clock, sleep : callables
        For tests.

    Returns
    -------
    RunReport

    Raises
    ------
    InputError
        If the source gives no frame at all.
    """
    dropped: list[tuple[int, float]] = []
    latencies_ms: list[float] = []
    steps_ms: list[float] = []
    error: InputError | None = None
    bug: Exception | None = None
    began, cpu_began = clock(), _cpu_s()
    source = iter(sequence)
    schedule = _Schedule(clock, sleep)
    frames: Iterator[tuple[Frame, float]] = ((frame, 0.0) for frame in source)
    if realtime:
        frames = _prepared(schedule.hand_out(source, dropped), prepare, schedule, clock)
    with _stop_on_signal() as stop, _switching_quickly(realtime):
        with _closing(source), _closing(frames):
            while not stop.is_set():
                while is_paused is not None and is_paused() and not stop.is_set():
                    sleep(PAUSE_S)
                if stop.is_set():
                    break
                try:
                    frame, spent_s = next(frames)
                except StopIteration:
                    break
                except InputError as problem:
                    if not latencies_ms:
                        raise
                    error = problem
                    break
                before = clock()
                late_s = schedule.late_s(frame, before) if realtime else 0.0
                if pace is not None and realtime:
                    pace.note(late_s - spent_s)
                pose_ms = None
                try:
                    result = system.step(frame)
                    pose_ms = result.pose_ms if realtime else None
                except Exception as problem:
                    bug = problem
                    break
                finally:
                    steps_ms.append(1e3 * (clock() - before))
                    latencies_ms.append(1e3 * max(late_s, 0.0) + (steps_ms[-1] if pose_ms is None else pose_ms))
                if on_frame is not None:
                    on_frame(replace(result, latency_ms=latencies_ms[-1]))
        interrupted = stop.is_set()
        if not latencies_ms and not interrupted:
            raise InputError(f"{sequence.name} gave no frame; check the source and which frames were asked for.")
        try:
            system.finish(interrupted=interrupted)
        except Exception as problem:
            bug = bug or problem  # a system that broke may well break again here: the first one tells why
    return RunReport(
        n_frames=len(latencies_ms) + len(dropped),
        dropped=tuple(dropped),
        latencies_ms=tuple(latencies_ms),
        steps_ms=tuple(steps_ms),
        n_late=schedule.n_late,
        wall_s=clock() - began,
        cpu_s=_cpu_s() - cpu_began,
        peak_rss_mb=_peak_rss_mb(),
        interrupted=interrupted,
        error=error,
        bug=bug,
    )


class _Schedule:
    """When frames are due: as far after the first one as their timestamps are."""

    def __init__(self, clock: Callable[[], float], sleep: Callable[[float], None]) -> None:
        self._clock = clock
        self._sleep = sleep
        self._first_s = 0.0
        self._began = 0.0
        self._in_time_at = 0.0
        self.n_late = 0

    def late_s(self, frame: Frame, now: float) -> float:
        """Return how long ago a frame was due."""
        # Absolute: a sequence that is read in reverse runs at the same rate.
        return now - self._began - abs(frame.timestamp_s - self._first_s)

    def hand_out(self, frames: Iterator[Frame], dropped: list[tuple[int, float]]) -> Iterator[Frame]:
        """Yield each frame when its time has come, and note as dropped those that came too late."""
        frame = next(frames, None)
        if frame is None:
            return
        self._first_s, self._began = frame.timestamp_s, self._clock()
        self._in_time_at = self._began
        while frame is not None:
            broken: InputError | None = None
            try:
                upcoming = next(frames, None)
            except InputError as error:  # after the frame in hand
                upcoming, broken = None, error
            now = self._clock()
            late_s = self.late_s(frame, now)
            if late_s <= LATE_S:
                self._in_time_at = now
            may_be_late_s = MAX_LATE_S if now - self._in_time_at < CATCH_UP_S else 0.0
            if upcoming is not None and late_s > may_be_late_s and self.late_s(upcoming, now) >= 0:
                dropped.append((frame.index, frame.timestamp_s))
            else:
                if late_s < 0:
                    self._sleep(-late_s)
                self.n_late += late_s > LATE_S
                yield frame
            if broken is not None:
                raise broken
            frame = upcoming


def _prepared(
    frames: Iterator[Frame], prepare: Callable[[Frame], Frame] | None, schedule: _Schedule, clock: Callable[[], float]
) -> Iterator[tuple[Frame, float]]:
    """Yield frames, and how long each was prepared: the next one is begun when the last was taken.

    One that comes in time finds nothing else to be done: it goes as it is, and leaves the other cores alone.
    """
    if prepare is None:
        return ((frame, 0.0) for frame in frames)

    def prepared() -> Iterator[tuple[Frame, float]]:
        for frame in frames:
            began = clock()
            late = schedule.late_s(frame, began) > LATE_S
            yield prepare(frame) if late else frame, clock() - began

    return read_ahead(prepared(), depth=1)


@contextmanager
def _switching_quickly(realtime: bool) -> Iterator[None]:
    """Let threads that wait for a pipe come to their turn soon, beside one that computes."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S if realtime else before)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


@contextmanager
def _closing(frames: Iterator[Any]) -> Iterator[None]:
    """Close a source that can be closed: one that reads ahead on a thread ends it then."""
    try:
        yield
    finally:
        close = getattr(frames, "close", None)
        if close is not None:
            close()


@contextmanager
def _stop_on_signal() -> Iterator[threading.Event]:
    """Turn the first SIGINT or SIGTERM into an event; outside the main thread, where no signal comes, do nothing."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def handle(number: int, stack: FrameType | None) -> None:
        stop.set()
        restore()

    for number in before:
        signal.signal(number, handle)
    try:
        yield stop
    finally:
        restore()


def _cpu_s() -> float:
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def _peak_rss_mb() -> float:
    peak = sum(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10
