"""The map, the buffer and the starts follow what is found to stand still."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from dualslam.core.events import EventKind
from dualslam.core.types import BoolArray, Failure, FailureReason, Features, FrameStatus, View
from dualslam.system.system import System
from dualslam.testing.point_world import SIZE_PX, PointWorld, cloud, hand_held, system_in

COLUMN = 0.25 * SIZE_PX[0]
"""What lies to the left of it stands still."""


@dataclass
class Left:
    """The left part of the image is found to stand still, at the frames that the tests say."""

    hidden: BoolArray | None = None
    camera_stands: bool = False
    refusal: Failure | None = None

    def refuse_start(self) -> Failure | None:
        return self.refusal

    def shows(self, features: Features) -> BoolArray:
        return np.asarray(features.uv_px[:, 0] > COLUMN)

    def masked(self, view: View) -> View:
        return replace(view, features=view.features.take(self.shows(view.features)))

    def find(self) -> None:
        self.hidden = np.zeros(SIZE_PX[::-1], np.bool_)
        self.hidden[:, : int(COLUMN)] = True


@pytest.fixture
def scene() -> Left:
    return Left()


@pytest.fixture
def system(scene: Left) -> System:
    system = system_in(PointWorld(cloud(), hand_held(60)))
    view_of = system._state.parts.view_of

    def masked(frame: object) -> View | Failure:
        view = view_of(frame)  # type: ignore[arg-type]
        return scene.masked(view) if isinstance(view, View) and scene.hidden is not None else view

    system._state.parts = replace(system._state.parts, scene=scene, view_of=masked)
    return system


def step(system: System, first: int, last: int) -> list[FrameStatus]:
    frames = PointWorld(cloud(), hand_held(60)).frames()
    return [system.step(frame).status for frame in frames[first:last]]


def test_a_map_loses_what_it_knows_of_it_and_goes_on(system: System, scene: Left) -> None:
    step(system, 0, 30)
    assert system.live is not None
    submap = system.live.submap
    scene.find()
    assert step(system, 30, 31) == [FrameStatus.TRACKED]
    rows = np.flatnonzero(submap.observations["alive"])
    for k in submap.keyframes:
        of_k = rows[submap.observations["kf"][rows] == k]
        assert (submap.keyframes[k].features.uv_px[submap.observations["feature"][of_k], 0] > COLUMN).all()
    (event,) = system.events.of_kind(EventKind.MASKED)
    assert event.frame == 30
    assert event.submap == submap.id
    assert event.data["share"] == pytest.approx(0.25, abs=0.01)
    assert event.data["observations_removed"] > 100
    assert set(step(system, 31, 60)) == {FrameStatus.TRACKED}


def test_without_a_map_the_frames_so_far_lose_it_and_are_started_from(system: System, scene: Left) -> None:
    scene.refusal = Failure(FailureReason.BUSY, "part of the image seems to stand still")
    assert set(step(system, 0, 20)) == {FrameStatus.INITIALISING}
    scene.find()
    scene.refusal = None
    step(system, 20, 40)
    assert all((view.features.uv_px[:, 0] > COLUMN).all() for view in system.buffer)
    assert system.live is not None
    assert min(system.live.submap.keyframes) < 20


def test_no_map_starts_of_what_passes_a_camera_at_rest(system: System, scene: Left) -> None:
    scene.camera_stands, scene.refusal = True, Failure(FailureReason.CAMERA_STANDS, "the camera stands still")
    step(system, 0, 20)
    scene.camera_stands, scene.refusal = False, None
    step(system, 20, 40)
    assert system.live is not None
    kinds = [event.event for event in system.events if event.event is not EventKind.INITIALISATION_REFUSED]
    assert kinds[:3] == [EventKind.CAMERA_STANDS, EventKind.CAMERA_MOVES, EventKind.INITIALISED]
