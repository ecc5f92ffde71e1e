from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from dualslam.core.errors import InputError
from dualslam.core.types import Frame
from dualslam.map.frame_records import FrameResult
from dualslam.run.results import frame_rows
from dualslam.run.runner import RunReport, run_sequence
from dualslam.system.pace import Pace
from tests.cli.fakes import FakeSystem

EVERYWHERE = {i: np.eye(4) for i in range(100)}


@dataclass
class Clock:
    """Time that passes only when someone works or sleeps."""

    now_s: float = 100.0
    slept_s: list[float] = field(default_factory=list)

    def __call__(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.slept_s.append(seconds)
        self.now_s += seconds


class Frames:
    """Frames at 10 Hz, of which the source may break."""

    name = "frames"
    rate_hz = 10.0

    def __init__(self, indices: list[int], break_after: int | None = None) -> None:
        self.indices, self.break_after, self.closed = indices, break_after, False

    def __len__(self) -> int:
        return len(self.indices)

    def __iter__(self) -> Iterator[Frame]:
        try:
            for n, i in enumerate(self.indices):
                if n == self.break_after:
                    raise InputError("the cable came off.")
                yield Frame(i, 0.1 * i, np.zeros((4, 4), np.uint8))
        finally:
            self.closed = True


def in_real_time(indices: list[int], work_s: dict[int, float]) -> tuple[list[int], list[int], Clock]:
    clock = Clock()

    def work(frame: Frame) -> None:
        clock.now_s += work_s.get(frame.index, 0.01)

    system = FakeSystem(EVERYWHERE, before_step=work)
    report = run_sequence(system, Frames(indices), realtime=True, clock=clock, sleep=clock.sleep)  # type: ignore[arg-type]
    assert report.n_frames == len(indices)
    assert [row.index for row in frame_rows(system, _no_poses())] == indices  # type: ignore[arg-type]
    return system.seen(), list(report.dropped), clock


def _no_poses() -> object:
    from dualslam.core.trajectory import Trajectory

    return Trajectory(np.zeros(0), np.zeros((0, 4, 4)))


def test_in_real_time_a_quick_system_waits_for_its_frames() -> None:
    seen, dropped, clock = in_real_time([0, 1, 2, 3], {})
    assert (seen, dropped) == ([0, 1, 2, 3], [])
    assert clock.slept_s == pytest.approx([0.09] * 3)


def test_in_real_time_a_slow_step_costs_the_frames_that_came_meanwhile() -> None:
    # Frame 1 is ready at 0.1 + 0.25 s: frame 2 (0.2 s) has been overtaken by frame 3 (0.3 s), which is taken late.
    seen, dropped, _ = in_real_time([0, 1, 2, 3, 4, 5], {1: 0.25})
    assert (seen, dropped) == ([0, 1, 3, 4, 5], [2])


def test_a_frame_may_be_as_late_as_two_of_a_quick_camera() -> None:
    class Quick(Frames):
        def __iter__(self) -> Iterator[Frame]:
            for i in self.indices:
                yield Frame(i, i / 30, None)

    # Frame 2 is looked at 1 / 30 s + 60 ms - 2 / 30 s late, while frame 3 is due already, and is caught up on.
    seen, report = quick_run(Quick(list(range(8))), {1: 0.060})
    assert (seen, report.dropped) == (list(range(8)), ())
    assert report.latencies_ms[2] == pytest.approx(60 - 33.3 + 10, abs=0.2)
    assert report.steps_ms[2] == pytest.approx(10)
    assert report.n_late == 2  # frame 3 waits a little for frame 2
    # After 160 ms frames 2 and 3 are dropped: they are 127 and 93 ms late. Frame 4 is 60 ms late, and taken.
    seen, report = quick_run(Quick(list(range(12))), {1: 0.160})
    assert report.dropped == (2, 3)
    assert report.latencies_ms[2] == pytest.approx(1e3 * (1 / 30 + 0.160 - 4 / 30) + 10, abs=0.2)


def test_who_is_never_in_time_gets_the_newest_frame() -> None:
    class Quick(Frames):
        def __iter__(self) -> Iterator[Frame]:
            for i in self.indices:
                yield Frame(i, i / 30, None)

    # 50 ms a step: within a second two of three frames are looked at, up to 1/15 s late; later ones are the newest.
    seen, report = quick_run(Quick(list(range(120))), dict.fromkeys(range(120), 0.050))
    late_ms = {i: latency - 50 for i, latency in zip(seen, report.latencies_ms, strict=True)}
    assert max(late for i, late in late_ms.items() if i < 30) > 50
    assert max(late for i, late in late_ms.items() if i > 40) < 1e3 / 30
    assert len(seen) == pytest.approx(120 * (1 / 30) / 0.050, abs=3)


@pytest.mark.parametrize(("delivery_s", "step_s"), [(0.0, 0.010), (0.012, 0.010), (0.012, 0.050)])
def test_a_camera_gives_a_frame_no_sooner_than_it_is_due_and_none_that_is_the_newest_is_dropped(
    delivery_s: float, step_s: float
) -> None:
    clock, began_s, period_s, n = Clock(), 100.0, 1 / 30, 120

    class Camera(Frames):
        """Waits for each frame; the first few come at once, later ones after some time."""

        def __iter__(self) -> Iterator[Frame]:
            for i in self.indices:
                clock.now_s = max(clock.now_s, began_s + i * period_s + (delivery_s if i >= 5 else 0.0))
                yield Frame(i, i * period_s, None)

    system = FakeSystem(EVERYWHERE, before_step=lambda frame: clock.sleep(step_s))
    report = run_sequence(system, Camera(list(range(n))), realtime=True, clock=clock, sleep=clock.sleep)  # type: ignore[arg-type]
    if step_s < period_s:
        assert report.dropped == ()
        assert report.latencies_ms[5:] == pytest.approx([1e3 * (delivery_s + step_s)] * (n - 5))
    else:
        assert len(report.latencies_ms) == pytest.approx(n * period_s / step_s, abs=3)
        assert report.dropped[-1] - report.dropped[0] > n / 2, "the rest is spread over the run"


def test_late_frames_are_prepared_on_another_thread_and_timely_ones_are_not() -> None:
    class AtOnce(Frames):
        def __iter__(self) -> Iterator[Frame]:
            for i in self.indices:
                yield Frame(i, 0.0, None)

    def run(frames: Frames, step_s: float) -> tuple[list[int], list[str]]:
        clock, prepared, threads = Clock(), [], []

        def work(frame: Frame) -> None:
            clock.now_s += step_s

        def prepare(frame: Frame) -> Frame:
            prepared.append(frame.index)
            threads.append(threading.current_thread().name)
            return frame

        report = run_sequence(
            FakeSystem(EVERYWHERE, before_step=work),
            frames,  # type: ignore[arg-type]
            realtime=True,
            prepare=prepare,
            clock=clock,
            sleep=clock.sleep,
        )
        assert len(report.latencies_ms) == len(frames)
        return prepared, threads

    prepared, threads = run(AtOnce(list(range(5))), 0.010)
    # The first finds the system idle, and so may the second, which is fetched as the first one's step begins.
    assert prepared[-3:] == [2, 3, 4]
    assert threading.current_thread().name not in threads
    assert run(Frames(list(range(5))), 0.0) == ([], [])


def test_a_source_that_breaks_while_frames_are_prepared_ends_the_run_with_what_there_is() -> None:
    clock, frames = Clock(), Frames([0, 1, 2, 3], break_after=2)
    report = run_sequence(
        FakeSystem(EVERYWHERE),
        frames,  # type: ignore[arg-type]
        realtime=True,
        prepare=lambda frame: frame,
        clock=clock,
        sleep=clock.sleep,
    )
    assert len(report.latencies_ms) == 2
    assert report.error is not None
    assert frames.closed


def test_the_latency_of_a_keyframe_ends_with_its_pose_and_not_with_the_map() -> None:
    clock = Clock()

    class PosesFirst(FakeSystem):
        def step(self, frame: Frame) -> FrameResult:
            clock.now_s += 0.05
            return replace(super().step(frame), pose_ms=20.0)

    for realtime, expected in ((True, 20.0), (False, 50.0)):
        system = PosesFirst(EVERYWHERE)
        report = run_sequence(system, Frames([0, 1]), realtime=realtime, clock=clock, sleep=clock.sleep)  # type: ignore[arg-type]
        assert report.latencies_ms == pytest.approx([expected] * 2)
        assert report.steps_ms == pytest.approx([50] * 2)


def quick_run(frames: Frames, work_s: dict[int, float]) -> tuple[list[int], RunReport]:
    clock = Clock()

    def work(frame: Frame) -> None:
        clock.now_s += work_s.get(frame.index, 0.01)

    system = FakeSystem(EVERYWHERE, before_step=work)
    report = run_sequence(system, frames, realtime=True, clock=clock, sleep=clock.sleep)  # type: ignore[arg-type]
    return system.seen(), report


def test_the_pace_is_told_how_late_frames_are_in_real_time_alone() -> None:
    class Told(Pace):
        def __init__(self) -> None:
            super().__init__()
            self.told_s: list[float] = []

        def note(self, late_s: float) -> None:
            self.told_s.append(late_s)

    clock, pace = Clock(), Told()
    system = FakeSystem(EVERYWHERE, before_step=lambda frame: clock.sleep(0.13))
    run_sequence(system, Frames([0, 1, 2]), realtime=True, pace=pace, clock=clock, sleep=clock.sleep)  # type: ignore[arg-type]
    assert pace.told_s == pytest.approx([0, 0.03, 0.06])
    run_sequence(system, Frames([0, 1, 2]), pace=pace, clock=clock, sleep=clock.sleep)  # type: ignore[arg-type]
    assert len(pace.told_s) == 3


def test_in_real_time_backwards() -> None:
    seen, dropped, _ = in_real_time([5, 4, 3, 2, 1], {4: 0.25})
    assert (seen, dropped) == ([5, 4, 2, 1], [3])


def test_latency_and_speed_are_measured() -> None:
    clock = Clock()

    def work(frame: Frame) -> None:
        clock.now_s += 0.02

    report = run_sequence(FakeSystem(EVERYWHERE, before_step=work), Frames([0, 1]), clock=clock)  # type: ignore[arg-type]
    assert report.latencies_ms == pytest.approx((20, 20))
    assert report.fps == pytest.approx(50)
    assert report.peak_rss_mb > 1
    assert report.cpu_s >= 0


def test_a_source_that_breaks_ends_the_run_and_keeps_its_frames() -> None:
    system, frames = FakeSystem(EVERYWHERE), Frames([0, 1, 2], break_after=2)
    report = run_sequence(system, frames)  # type: ignore[arg-type]
    assert str(report.error) == "the cable came off."
    assert list(system.rows) == [0, 1]
    assert system.n_finished == 1
    assert frames.closed


def test_a_system_that_breaks_is_finished_and_what_it_raised_first_is_reported() -> None:
    class Broken(FakeSystem):
        def step(self, frame: Frame) -> FrameResult:
            if frame.index == 2:
                raise ZeroDivisionError("in a step")
            return super().step(frame)

        def finish(self, interrupted: bool = False) -> None:
            super().finish()
            raise ValueError("at the end")

    system, frames = Broken(EVERYWHERE), Frames([0, 1, 2, 3])
    report = run_sequence(system, frames)  # type: ignore[arg-type]
    assert isinstance(report.bug, ZeroDivisionError)
    assert (report.n_frames, list(system.rows), system.n_finished) == (3, [0, 1], 1)
    assert frames.closed
    assert isinstance(run_sequence(Broken(EVERYWHERE), Frames([0])).bug, ValueError)  # type: ignore[arg-type]


def test_whatever_a_source_or_a_callback_raises_ends_the_run_as_a_system_that_breaks_does() -> None:
    class Unplugged(Frames):
        def __iter__(self) -> Iterator[Frame]:
            yield from super().__iter__()
            raise OSError("unplugged")

    clock = Clock()
    for realtime in (False, True):
        system = FakeSystem(EVERYWHERE)
        report = run_sequence(system, Unplugged([0, 1]), realtime=realtime, clock=clock, sleep=clock.sleep)  # type: ignore[arg-type]
        assert isinstance(report.bug, OSError)
        assert (list(system.rows), system.n_finished) == ([0, 1], 1)
    with pytest.raises(OSError, match="unplugged"):
        run_sequence(FakeSystem(EVERYWHERE), Unplugged([]))  # type: ignore[arg-type]

    def stop(result: FrameResult) -> None:
        raise ZeroDivisionError

    system = FakeSystem(EVERYWHERE)
    report = run_sequence(system, Frames([0, 1]), on_frame=stop)  # type: ignore[arg-type]
    assert isinstance(report.bug, ZeroDivisionError)
    assert (list(system.rows), system.n_finished) == ([0], 1)


@pytest.mark.parametrize("stops", [False, True])
def test_who_interrupts_a_run_does_not_wait_for_a_last_walk(stops: bool) -> None:
    def interrupt(frame: Frame) -> None:
        if stops and frame.index == 1:
            signal.raise_signal(signal.SIGINT)

    system = FakeSystem(EVERYWHERE, before_step=interrupt)
    report = run_sequence(system, Frames([0, 1, 2]))  # type: ignore[arg-type]
    assert (report.interrupted, system.was_interrupted, system.n_finished) == (stops, stops, 1)


def test_who_is_impatient_with_a_source_that_stalls_keeps_what_there_is() -> None:
    stalled, go_on = threading.Event(), threading.Event()

    class Stalls(Frames):
        def __iter__(self) -> Iterator[Frame]:
            yield from super().__iter__()
            stalled.set()
            go_on.wait(30)

    def interrupt_twice(frame: Frame) -> None:
        if frame.index == 1:
            assert stalled.wait(30)  # another thread is in the source from here on
            signal.raise_signal(signal.SIGINT)
            threading.Timer(0.2, signal.pthread_kill, [threading.main_thread().ident, signal.SIGINT]).start()

    system = FakeSystem(EVERYWHERE, before_step=interrupt_twice)
    try:
        report = run_sequence(system, Stalls([0, 1]), realtime=True, prepare=lambda frame: frame)  # type: ignore[arg-type]
    finally:
        go_on.set()
    assert report.interrupted
    assert (list(system.rows), system.n_finished) == ([0, 1], 1)


def test_a_source_without_frames_is_bad_input() -> None:
    with pytest.raises(InputError, match="gave no frame"):
        run_sequence(FakeSystem(EVERYWHERE), Frames([]))  # type: ignore[arg-type]
    with pytest.raises(InputError, match="cable"):
        run_sequence(FakeSystem(EVERYWHERE), Frames([0], break_after=0))  # type: ignore[arg-type]


def test_on_frame_is_told_every_result() -> None:
    seen = []
    run_sequence(FakeSystem(EVERYWHERE), Frames([4, 2]), on_frame=seen.append)  # type: ignore[arg-type]
    assert [result.index for result in seen] == [4, 2]


def test_a_paused_run_waits_and_an_interrupt_ends_the_pause() -> None:
    clock, asked = Clock(), 0

    def paused_at_the_third() -> bool:
        nonlocal asked
        asked += 1
        return 3 <= asked < 13

    report = run_sequence(
        FakeSystem(EVERYWHERE), Frames(list(range(5))), is_paused=paused_at_the_third, clock=clock, sleep=clock.sleep
    )
    assert report.n_frames == 5
    assert len(clock.slept_s) == 10
    assert max(report.steps_ms) == 0, "a pause is no latency"

    def pause_and_interrupt() -> bool:
        signal.raise_signal(signal.SIGINT)
        return True

    report = run_sequence(FakeSystem(EVERYWHERE), Frames(list(range(5))), is_paused=pause_and_interrupt)
    assert report.interrupted
    assert report.n_frames == 0
