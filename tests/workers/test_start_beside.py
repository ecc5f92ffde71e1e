"""A start that is looked for beside the tracking: the same one, some frames late, and the frames since are posed."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from dualslam.build import create_frontend, new_initialiser
from dualslam.core.events import EventKind
from dualslam.core.jobs import InlineDesk, JobKind
from dualslam.core.types import Failure, FailureReason, FrameStatus, Start, View
from dualslam.frontends.tracking.initialiser import Initialiser
from dualslam.system.system import System
from dualslam.testing.late_desk import LateDesk
from dualslam.testing.point_world import CAMERA, SIZE_PX, PointWorld, cloud, hand_held, pose_errors, system_in
from dualslam.workers.start_beside import StartBeside, StartServer

N = 40


def server(system: System) -> StartServer:
    frontend = create_frontend(system._state.config.frontend)
    return StartServer(partial(new_initialiser, system._state.config, frontend, SIZE_PX))


def beside(world: PointWorld, polls: int) -> tuple[System, LateDesk]:
    """A system in real time whose start comes `polls` frames late."""
    system = system_in(world)
    desk = LateDesk(InlineDesk({JobKind.START: server(system)}), polls)
    inline = system._state.parts.new_starter
    system._state.parts = replace(system._state.parts, new_starter=lambda: StartBeside(desk, inline(), CAMERA.K))
    system._starting._starter = system._state.parts.new_starter()
    system.pace.note(0.0)
    return system, desk


@pytest.fixture(scope="module")
def world() -> PointWorld:
    return PointWorld(cloud(600), hand_held(N))


@pytest.mark.parametrize("polls", [0, 1, 6])
def test_a_start_that_comes_late_leaves_no_frame_without_a_pose(world: PointWorld, polls: int) -> None:
    system, _ = beside(world, polls)
    posed = [system.step(frame).status is FrameStatus.TRACKED for frame in world.frames()]
    first = posed.index(True)
    assert all(posed[first:])
    started = system.events.of_kind(EventKind.INITIALISED)[0]
    assert first - started.frame == polls + 1, "the search ends with a frame that came so long before"
    since = list(range(started.frame, N))
    assert all(system.rows[i].status is FrameStatus.TRACKED for i in since)
    system.finish()
    poses = [system.poses[i] for i in since]
    T = np.array([system.atlas.submaps[0].resolve_anchor(p.keyframe_id, p.T_kf_cam) for p in poses])
    position, rotation = pose_errors(T, world.T_world_cam[since])
    assert position.max() < 0.08
    assert rotation.max() < 0.01


class Dying:
    """A search that forgets all with its second frame, as a process that dies."""

    def __init__(self, inner: StartServer, new: StartServer) -> None:
        self.inner, self.new, self.n = inner, new, 0
        self.asked: list[int] = []

    def __call__(self, question: object) -> Start | Failure:
        self.n += 1
        self.asked.append(len(question.views))  # type: ignore[attr-defined]
        if self.n == 2:
            self.inner = self.new
            return Failure(FailureReason.WORKER, "gone")
        return self.inner(question)  # type: ignore[arg-type]


def test_a_search_that_is_lost_is_begun_anew_with_all_frames(world: PointWorld) -> None:
    system = system_in(world)
    dying = Dying(server(system), server(system))
    starter = StartBeside(InlineDesk({JobKind.START: dying}), system._state.parts.new_starter(), CAMERA.K)
    found = [starter.add(view, briefly=True) for view in world.views()]
    assert dying.asked[:3] == [1, 1, 3], "with the third, all three are sent"
    assert any(isinstance(f, Start) for f in found)


def test_answers_to_an_earlier_search_are_not_taken(world: PointWorld) -> None:
    system, views = system_in(world), world.views()
    desk = LateDesk(InlineDesk({JobKind.START: server(system)}), 0)
    earlier, n = StartBeside(desk, system._state.parts.new_starter(), CAMERA.K), 0
    while not any(isinstance(ended.result, Start) for _, ended in desk.waiting.get(JobKind.START, [])):
        assert not earlier.add(views[n], briefly=True)
        n += 1
    later = StartBeside(desk, system._state.parts.new_starter(), CAMERA.K)
    assert not later.add(views[n], briefly=True), "the start that waits there is not its own"
    assert not desk.waiting[JobKind.START] or desk.waiting[JobKind.START][0][1].work.views[-1].index == n


def test_without_haste_it_searches_here(world: PointWorld) -> None:
    system = system_in(world)
    new_starter = system._state.parts.new_starter
    here, there = new_starter(), StartBeside(InlineDesk({}), new_starter(), CAMERA.K)
    assert isinstance(here, Initialiser)
    for view in world.views():
        mine, theirs = here.add(view), there.add(view)
        assert bool(mine) == bool(theirs)
        if mine and theirs:
            np.testing.assert_array_equal(mine.xyz, theirs.xyz)
            return
    pytest.fail("no start")


class Waiting:
    """A search that never finds a start, and notes for how long it has been waited for one."""

    def __init__(self) -> None:
        self.waited_s: list[float] = []

    def collect(self, view: View) -> None: ...

    def add(self, view: View, waited_s: float = 0.0, briefly: bool = False) -> Failure:
        self.waited_s.append(waited_s)
        return Failure(FailureReason.LOW_PARALLAX, "")


@pytest.mark.parametrize("there", [False, True])
def test_how_long_there_has_been_no_map_is_told_though_the_search_begins_anew(world: PointWorld, there: bool) -> None:
    system, waiting = system_in(world), Waiting()
    desk = InlineDesk({JobKind.START: StartServer(lambda K: waiting)})
    system._state.parts = replace(
        system._state.parts, new_starter=lambda: StartBeside(desk, waiting, CAMERA.K) if there else waiting
    )
    system._starting.begin_again()
    if there:
        system.pace.note(0.0)
    frames = list(world.frames())
    for n, frame in enumerate(frames):
        if n == N // 2:
            system._starting.begin_again()
        system.step(frame)
    expected = np.array([frame.timestamp_s - frames[0].timestamp_s for frame in frames])
    np.testing.assert_allclose(waiting.waited_s, expected, atol=1e-9)
