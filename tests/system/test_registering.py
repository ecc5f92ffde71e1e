"""The end of a run: frames without a pose are found in the main map."""

from __future__ import annotations

import pytest

from dualslam.core.events import EventKind
from dualslam.core.types import FrameStatus
from dualslam.run.results import trajectories_of
from dualslam.system.system import System
from dualslam.testing.point_world import PointWorld, cloud, hand_held, pose_errors, system_in

POSITION_M, ROTATION_RAD = 0.05, 0.01
COVERED = frozenset(range(30, 45))
RETURN = (45, 46)
"""Two frames that show the map again: too few for tracking, which asks for three."""


@pytest.fixture(scope="module")
def world() -> PointWorld:
    """Return a walk that is covered for a while, and ends with a look at its middle."""
    return PointWorld(cloud(400), hand_held(len(COVERED) + 32)[[*range(30), *COVERED, 20, 21]], covered=COVERED)


def ended(world: PointWorld, recovers: bool) -> System:
    """Run the system through a world."""
    system = system_in(world, recovery={"enabled": recovers})
    for frame in world.frames():
        system.step(frame)
    system.finish()
    return system


def test_frames_without_a_pose_are_found_at_the_end(world: PointWorld) -> None:
    system = ended(world, recovers=True)
    (event,) = system.events.of_kind(EventKind.REGISTERED)
    assert event.data["frames"] == len(RETURN)
    assert {system.rows[i].status for i in RETURN} == {FrameStatus.RECOVERED}
    main = trajectories_of(system).main
    assert set(RETURN) <= set(main.index.tolist())
    position, angle = pose_errors(main.T_world_cam, world.T_world_cam[main.index])
    assert position.max() < POSITION_M
    assert angle.max() < ROTATION_RAD
    assert not COVERED & set(main.index.tolist())


def test_in_real_time_they_are_found_too(world: PointWorld) -> None:
    system = system_in(world, recovery={"enabled": True})
    for frame in world.frames():
        system.pace.note(0.0)
        system.step(frame)
    system.finish()
    (event,) = system.events.of_kind(EventKind.REGISTERED)
    assert event.data["frames"] == len(RETURN)


def test_without_recovery_they_stay_without(world: PointWorld) -> None:
    system = ended(world, recovers=False)
    assert not system.events.of_kind(EventKind.REGISTERED)
    assert not set(RETURN) & system.poses.keys()
