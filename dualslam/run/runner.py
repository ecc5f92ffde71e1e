"""The harness around the algorithm: feeds a system the frames of a sequence, keeps time, and stops when asked to."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from typing import Any, Protocol

from dualslam.core.errors import InputError, OutputError
from dualslam.core.interfaces import Sequence
from dualslam.core.resources import peak_rss_mb
from dualslam.core.schedule import Recorded
from dualslam.core.types import Frame
from dualslam.map.frame_records import FrameResult
from dualslam.run.interrupts import Interrupts
from dualslam.run.schedule import Handed, Schedule, as_recorded, prepared
from dualslam.system.pace import Pace

PAUSE_S = 0.05
"""Between two looks at whether a run is to go on."""
SWITCH_S = 5e-4
"""How long a thread computes while another waits for its turn, in real time: features would wait 5 ms at each step."""


class Steppable(Protocol):
    """Interface of a system for the harness."""

    def step(self, frame: Frame) -> FrameResult:
        """Take one frame."""
        ...

    def keep(self, frame: Frame) -> None:
        """Keep a frame that came too late to be looked at."""
        ...

    def finish(self, interrupted: bool = False) -> None:
        """End the run; in a `interrupted` with what there is."""
        ...


@dataclass(frozen=True, slots=True)
class RunReport:
    """Cost and end of a run. The map itself stays in the system."""

    n_frames: int  # frames that the source gave, those dropped included
    latencies_ms: tuple[float, ...]
    """Of each frame that was looked at: in real time from the moment when it was due to its pose, waiting included (to
    the end of its step, where it has none). Else the wall time of its step."""
    steps_ms: tuple[float, ...]  # wall time of each step
    # From the first frame to the end; user and system time of this process and of the children that have ended.
    wall_s: float
    cpu_s: float
    peak_rss_mb: float
    """Highest resident memory of the process since it started, and of the largest of its children that have ended."""
    dropped: tuple[int, ...] = ()
    """Index in the source of the frames that came too late to be tracked (`realtime`)."""
    n_late: int = 0  # frames that the system was ready for only after their time (`realtime`)
    interrupted: bool = False  # true where a signal ended the run early, its end too
    error: InputError | OutputError | None = None
    """What ended the source early, or kept its results from being written."""
    bug: Exception | None = None
    """What else was raised and ended the run: by the system, the source or `on_frame`, no property of the input."""

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
    interrupts: Interrupts | None = None,
    repeats: Recorded | None = None,
    clock: Callable[[], float] = time.perf_counter,
    sleep: Callable[[float], None] = time.sleep,
) -> RunReport:
    """Feed a system all frames of a sequence, then finish it.

    The first SIGINT, SIGTERM or SIGHUP ends the run after the current frame, so that the results can be saved. The
    second one abandons this frame, or the end of the run, too. The third one acts as always. Any exception after the
    first frame (source, system, `on_frame`, full disk) ends the run in the same way. It is in the report, for the
    caller to raise again once the rest is saved.

    - `realtime`: frames come at the times that their timestamps tell, and those that are too late are not tracked, but
      kept (`Steppable.keep`): a frame is, if it is more than `MAX_LATE_S` late when the system is ready for it, and
      the next one is due already. A system that has not been in time for `CATCH_UP_S` is given the newest frame.
    - `prepare`: in real time: called with a frame, on a thread of its own, while the one before it is in its step;
      returns what the system is given.
    - `pace`: receives, in real time, how late each frame is.
    - `on_frame`: called with the result of each step.
    - `is_paused`: asked before each frame; the run waits for as long as it says so, or until a signal ends it.
    - `interrupts`: entered already, where the caller has more to do that signals must not end.
    - `repeats`: the schedule of a run that is repeated: its frames are given as they were then.
    - `clock`, `sleep`: for tests.

    Raises `InputError` if the source gives no frame at all.
    Raises `Exception`: whatever the source raises before its first frame.
    """
    began, cpu_began = clock(), _cpu_s()
    source = iter(sequence)
    schedule = Schedule(clock, sleep)
    frames = map(Handed, source) if repeats is None else as_recorded(source, repeats)
    if realtime:
        frames = prepared(schedule.hand_out(source), prepare, schedule, clock)
    steps = _Steps(system, schedule if realtime else None, pace, on_frame, clock)
    with Interrupts() if interrupts is None else nullcontext(interrupts) as stop, _switching_quickly(realtime):

        def may_go_on() -> bool:
            while is_paused is not None and is_paused() and not stop.asked:
                sleep(PAUSE_S)
            return not stop.asked

        with stop.leave_at_second(), _closing(source), _closing(frames):
            while may_go_on() and steps.take_next(frames):
                pass
        interrupted = stop.asked
        if not steps.latencies_ms and not interrupted:
            raise InputError(f"{sequence.name} gave no frame; check the source and which frames were asked for.")
        try:
            with stop.leave_at_second():
                system.finish(interrupted=interrupted or (repeats is not None and repeats.interrupted))
        except OutputError as problem:
            steps.error = steps.error or problem
        except Exception as problem:
            steps.bug = steps.bug or problem  # a system that broke may well break again here: the first one tells why
    return RunReport(
        n_frames=len(steps.latencies_ms) + len(steps.dropped),
        dropped=tuple(steps.dropped),
        latencies_ms=tuple(steps.latencies_ms),
        steps_ms=tuple(steps.steps_ms),
        n_late=schedule.n_late,
        wall_s=clock() - began,
        cpu_s=_cpu_s() - cpu_began,
        peak_rss_mb=peak_rss_mb(with_children=True),
        interrupted=interrupted or stop.left,
        error=steps.error,
        bug=steps.bug,
    )


class _Steps:
    """Gives a system one frame after the other (in real time by a schedule), and notes how long each took."""

    def __init__(
        self,
        system: Steppable,
        schedule: Schedule | None,
        pace: Pace | None,
        on_frame: Callable[[FrameResult], None] | None,
        clock: Callable[[], float],
    ) -> None:
        self._system, self._schedule, self._pace = system, schedule, pace
        self._on_frame, self._clock = on_frame, clock
        self.latencies_ms: list[float] = []
        self.steps_ms: list[float] = []
        self.dropped: list[int] = []
        self.error: InputError | OutputError | None = None
        self.bug: Exception | None = None

    def take_next(self, frames: Iterator[Handed]) -> bool:
        """Give the system the next frame; return whether another may follow.

        Raises `Exception`: the source breaks before its first frame.
        """
        try:
            handed = next(frames)
        except StopIteration:
            return False
        except Exception as problem:
            if not self.latencies_ms:
                raise
            self._end(problem)
            return False
        for late in handed.dropped:
            self._system.keep(late)
            self.dropped.append(late.index)
        result = self._step(handed.frame, handed.prepared_s)
        if result is None:
            return False
        try:
            if self._on_frame is not None:
                self._on_frame(replace(result, latency_ms=self.latencies_ms[-1]))
        except Exception as problem:
            self._end(problem)
            return False
        return True

    def _end(self, problem: Exception) -> None:
        """Note what has ended the frames; an error of the input, or of the output, is no bug."""
        if isinstance(problem, InputError | OutputError):
            self.error = problem
        else:
            self.bug = problem

    def _step(self, frame: Frame, spent_s: float) -> FrameResult | None:
        """Return the result of one step, None if it raised; `spent_s`: how long the frame was prepared."""
        before, pose_ms = self._clock(), None
        late_s = 0.0 if self._schedule is None else self._schedule.late_s(frame, before)
        if self._pace is not None and self._schedule is not None:
            self._pace.note(late_s - spent_s)
        try:
            result = self._system.step(frame)
            pose_ms = None if self._schedule is None else result.pose_ms
        except OutputError as problem:
            self.error = problem
            return None
        except Exception as problem:
            self.bug = problem
            return None
        finally:
            self.steps_ms.append(1e3 * (self._clock() - before))
            self.latencies_ms.append(1e3 * max(late_s, 0.0) + (self.steps_ms[-1] if pose_ms is None else pose_ms))
        return result


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
            # A generator that another thread is in, which was not waited for, says so; it ends with that thread.
            with suppress(ValueError):
                close()


def _cpu_s() -> float:
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)
