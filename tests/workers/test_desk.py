"""The desk for work beside the tracking: lanes, order, bounds, and what a dead or hung worker costs."""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
import weakref
from collections.abc import Callable
from dataclasses import replace
from threading import Thread
from typing import Any

import numpy as np
import pytest

from dualslam.core.grey_image import GreyImage
from dualslam.core.jobs import Ended, InlineDesk, JobKind
from dualslam.core.types import Failure, FailureReason
from dualslam.testing.desk_work import handlers, lane, working
from dualslam.testing.point_world import PointWorld, cloud, hand_held
from dualslam.testing.waiting import wait_until
from dualslam.workers.desk import WorkerDesk
from dualslam.workers.transport import Channel
from tests.workers.test_worker import gone

GRAPH, CALIBRATION, WALK = JobKind.GRAPH, JobKind.CALIBRATION, JobKind.WALK


@pytest.fixture
def ends() -> tuple[Channel, Channel]:
    ours, theirs = multiprocessing.Pipe()
    return Channel(ours, gives=True), Channel(theirs, gives=False)


def through(sender: Channel, receiver: Channel, thing: Any) -> tuple[Any, int]:
    """What comes out at the other end, and how many bytes it took; a pipe does not hold it, so that two must work."""
    sizes: list[int] = []
    thread = Thread(target=lambda: sizes.append(sender.send(thing)))
    thread.start()
    got = receiver.receive()
    thread.join()
    return got, sizes[0]


def test_what_goes_through_a_pipe_is_the_same_at_the_other_end_and_can_be_written_to(
    ends: tuple[Channel, Channel],
) -> None:
    large, small = np.arange(3e5).reshape(-1, 3), np.arange(5)
    thing = {"large": large, "again": large, "part": large[::2], "small": small, "empty": np.zeros((0, 7)), "word": "w"}
    got, _ = through(*ends, thing)
    assert got["word"] == "w"
    for name in ("large", "again", "part", "small", "empty"):
        np.testing.assert_array_equal(got[name], thing[name])
    assert got["large"] is got["again"]
    for name in ("large", "part", "small", "empty"):
        got[name][:] = 0
    assert large[-1, -1] == 3e5 - 1


def test_the_other_end_that_is_closed_is_told() -> None:
    ours, theirs = multiprocessing.Pipe()
    ours.close()
    with pytest.raises(EOFError):
        Channel(theirs, gives=False).receive()


def test_what_never_changes_goes_once_and_comes_back_as_itself(ends: tuple[Channel, Channel]) -> None:
    here, there = ends
    world = PointWorld(cloud(), hand_held(3))
    image = GreyImage.of(np.arange(120_000, dtype=np.uint32).astype(np.uint8).reshape(300, 400))
    views = [replace(world.view(i), image=image) for i in range(3)]
    first, n_first = through(here, there, views[:2])
    second, n_second = through(here, there, views)
    assert n_second < 0.6 * n_first  # one more view's features, and no image
    assert first[0].features is second[0].features
    assert first[1].image is second[2].image
    np.testing.assert_array_equal(second[2].features.descriptors, views[2].features.descriptors)
    np.testing.assert_array_equal(first[0].image.pixels(), image.pixels())
    back, n_back = through(there, here, {"known": second, "new": world.features(0)})
    assert back["known"][2].features is views[2].features
    assert n_back < n_first
    # What was made there is not kept there: it goes whole when it is needed again.
    again, _ = through(here, there, back["new"])
    np.testing.assert_array_equal(again.uv_px, back["new"].uv_px)


def test_what_nobody_holds_any_more_is_let_go_at_the_other_end(ends: tuple[Channel, Channel]) -> None:
    here, there = ends
    world = PointWorld(cloud(), hand_held(3))
    view = world.view(0)
    got, _ = through(here, there, view)
    held = weakref.ref(got.features)
    del view, got
    gc.collect()
    assert held() is not None
    through(here, there, "next")
    gc.collect()
    assert held() is None


def collect(desk: WorkerDesk, kind: JobKind, n: int = 1) -> list[Ended]:
    ended: list[Ended] = []

    def are_there() -> bool:
        ended.extend(desk.poll(kind))
        return len(ended) >= n

    wait_until(are_there)
    return ended


def reasons(ended: list[Ended]) -> list[FailureReason | None]:
    return [e.result.reason if isinstance(e.result, Failure) else None for e in ended]


def test_an_array_comes_back_changed_and_the_one_that_was_given_stays() -> None:
    given = np.arange(1e5)
    with working(lane(CALIBRATION)) as desk:
        desk.submit(CALIBRATION, given)
        (ended,) = collect(desk, CALIBRATION)
    assert ended.work is given
    assert given[3] == 3
    np.testing.assert_array_equal(ended.result, 2 * given)
    assert desk.statistics[CALIBRATION].n_done == 1
    assert desk.statistics[CALIBRATION].n_failed == 0


def test_a_walk_does_not_stand_before_the_graph_that_has_a_lane_of_its_own() -> None:
    with working(lane(GRAPH), lane(WALK, niceness=3)) as desk:
        desk.submit(WALK, ("sleep", 600.0))
        for number in (1.0, 2.0, 3.0):
            desk.submit(GRAPH, number)
        assert [ended.result for ended in collect(desk, GRAPH, 3)] == [1.0, 3.0, 6.0]  # in order, on one state
        assert desk.n_open(WALK) == 1


def test_a_lane_for_long_work_stands_behind_the_tracking() -> None:
    with working(lane(WALK, niceness=3)) as desk:
        desk.submit(WALK, ("ask", 0.0))
        (ended,) = collect(desk, WALK)
    pid, niceness = ended.result
    assert pid != os.getpid()
    assert niceness >= min(os.nice(0) + 3, 19)


def test_the_most_urgent_kind_that_waits_goes_first() -> None:
    with working(lane(CALIBRATION, WALK)) as desk:
        begun: list[JobKind] = []
        desk.on_start = lambda kind, work, pid: begun.append(kind)
        for _ in range(3):
            desk.submit(WALK, ("sleep", 0.0))
        desk.submit(CALIBRATION, np.zeros(3))
        ended = desk.drain(WALK)
    assert begun == [WALK, CALIBRATION, WALK, WALK]
    assert reasons(ended) == [None] * 3


def test_one_job_too_many_ends_at_once() -> None:
    with working(lane(WALK, max_waiting=2)) as desk:
        for seconds in (600.0, 1.0, 2.0, 3.0):
            desk.submit(WALK, ("sleep", seconds))
        (ended,) = desk.poll(WALK)
        assert ended.work == ("sleep", 3.0)
        assert reasons([ended]) == [FailureReason.BUSY]
        assert desk.n_open(WALK) == 3
        assert desk.statistics[WALK].max_waiting == 2


def test_what_is_not_waited_for_any_longer_leaves_its_place_to_others() -> None:
    with working(lane(WALK, CALIBRATION), finish_wait_s=0.5) as desk:
        assert desk.wait_until_ready()
        desk.submit(WALK, ("sleep", 600.0))
        desk.submit(CALIBRATION, np.arange(3.0))
        assert reasons(desk.drain(WALK)) == [FailureReason.TIMEOUT]
        (ended,) = collect(desk, CALIBRATION)
        np.testing.assert_array_equal(ended.result, [0, 2, 4])
        desk.submit(CALIBRATION, np.ones(1))
        assert collect(desk, CALIBRATION)[0].result == 2


def test_a_map_that_is_no_longer_live_withdraws_what_waits_for_it_and_nothing_else() -> None:
    with working(lane(CALIBRATION, WALK)) as desk:
        desk.submit(WALK, ("sleep", 0.5))
        desk.submit(CALIBRATION, np.arange(3.0), of=0)
        desk.submit(CALIBRATION, np.ones(3), of=1)
        desk.submit(WALK, ("sleep", 0.0))
        assert [desk.n_open(CALIBRATION, of) for of in (0, 1, 2, None)] == [1, 1, 0, 2]
        desk.withdraw(0)
        assert [desk.n_open(CALIBRATION, of) for of in (0, 1, 2, None)] == [0, 1, 0, 1]
        assert [ended.result.tolist() for ended in desk.drain(CALIBRATION)] == [[2, 2, 2]]
        assert reasons(desk.drain(WALK)) == [None] * 2


def kill(desk: WorkerDesk) -> None:
    os.kill(desk.pids[0] or 0, signal.SIGKILL)


def stop(desk: WorkerDesk) -> None:
    os.kill(desk.pids[0] or 0, signal.SIGSTOP)


@pytest.mark.parametrize(
    ("harm", "reason", "detail"),
    [
        (kill, FailureReason.WORKER, "-9"),
        pytest.param(stop, FailureReason.TIMEOUT, "", marks=pytest.mark.slow),
    ],
)
def test_a_worker_that_dies_or_hangs_costs_its_job(
    harm: Callable[[WorkerDesk], None], reason: FailureReason, detail: str
) -> None:
    with working(lane(GRAPH, time_limit_s=5.0)) as desk:
        (pid,) = desk.pids
        harm(desk)
        desk.on_start = lambda kind, work, pid: None
        desk._queues[0].idle[0]._process.is_alive = lambda: True  # type: ignore[method-assign]  # it harms at work
        desk.submit(GRAPH, 5.0)
        desk.submit(GRAPH, 7.0)
        first, second = collect(desk, GRAPH, 2)
        assert gone(pid)
        assert desk.pids != [pid]
    assert reasons([first]) == [reason]
    assert detail in first.result.detail
    assert second.result == 7.0  # a fresh one, without the state of the other
    assert desk.statistics[GRAPH].n_failed == 1


def test_a_worker_that_died_while_idle_is_replaced() -> None:
    with working(lane(GRAPH)) as desk:
        kill(desk)
        wait_until(lambda: not desk._queues[0].idle[0].alive)
        desk.submit(GRAPH, 7.0)
        assert collect(desk, GRAPH)[0].result == 7.0


def test_the_end_of_a_run_waits_so_long_and_no_longer() -> None:
    with working(lane(WALK), finish_wait_s=0.2) as desk:
        (pid,) = desk.pids
        stop(desk)
        desk.submit(WALK, ("sleep", 0.0))
        desk.submit(WALK, ("sleep", 0.0))
        assert reasons(desk.drain(WALK)) == [FailureReason.TIMEOUT] * 2
    assert gone(pid)


def test_a_desk_says_when_its_workers_are_warm() -> None:
    with working(lane(GRAPH), lane(WALK)) as desk:
        assert desk.wait_until_ready()
        desk.submit(GRAPH, 1.0)
        assert collect(desk, GRAPH)[0].result == 1.0


def test_one_that_exits_by_itself_says_how() -> None:
    with working(lane(WALK)) as desk:
        desk.submit(WALK, ("die", 0.0))
        (ended,) = collect(desk, WALK)
    assert isinstance(ended.result, Failure)
    assert "exit code 3" in ended.result.detail


def test_inline_the_work_is_done_when_it_is_asked_for() -> None:
    desk = InlineDesk(handlers())
    for number in (1.0, 2.0):
        desk.submit(GRAPH, number)
    assert desk.n_open(GRAPH) == 0
    assert [ended.result for ended in desk.poll(GRAPH)] == [1.0, 3.0]
    assert desk.drain(GRAPH) == []
