"""A lost map that no link joins: its frames are registered in the main map at the end of the run."""

from __future__ import annotations

import pytest

from dualslam.core.events import EventKind
from dualslam.run.results import frame_rows, trajectories_of
from dualslam.system.system import System
from dualslam.testing.point_world import PointWorld, cloud, hand_held, pose_errors, system_in

COVERED = frozenset(range(35, 50))
NO_LINK = {"min_inliers": 1_000_000}
POSITION_M, ROTATION_RAD = 0.08, 0.01


def run(n_frames: int, **settings: object) -> tuple[System, PointWorld]:
    world = PointWorld(cloud(500), hand_held(n_frames), covered=COVERED)
    values = {"recovery": {"attempts": ["live"], "retry_keyframes": [1000]}, "linking": NO_LINK} | settings
    system = system_in(world, **values)
    for frame in world.frames():
        system.step(frame)
    return system, world


@pytest.mark.slow
@pytest.mark.parametrize("n_frames", [75, 110])
@pytest.mark.parametrize("buffer_s", [10.0, 3.5])
def test_the_smaller_map_gives_its_frames_to_the_larger_one(n_frames: int, buffer_s: float) -> None:
    """Whichever was lost, and whether or not reverse tracking has been over all of it: in 3.5 s it has not."""
    system, world = run(n_frames, buffer={"duration_s": buffer_s})
    system.finish()
    assert not system.atlas.links
    (event,) = system.events.of_kind(EventKind.REGISTERED)
    main = trajectories_of(system).main
    assert main.index.tolist() == [i for i in range(n_frames) if i not in COVERED]
    assert event.data["old_submaps"] == [1 - event.submap]
    assert {row.submap for row in frame_rows(system, main) if row.in_main_map} == {event.submap}
    translation, rotation = pose_errors(main.T_world_cam, world.T_world_cam[main.index])
    assert translation.max() < POSITION_M
    assert rotation.max() < ROTATION_RAD


@pytest.mark.slow
def test_a_map_that_was_tracked_under_another_camera_gives_its_frames_to_the_one_that_found_the_camera() -> None:
    """Though it is the larger one: the wrong camera has bent it."""
    system, _ = run(75)
    lost, later = sorted(system.atlas.submaps)
    held = [sum(pose.submap_id == m for pose in system.poses.values()) for m in (lost, later)]
    assert held[0] > held[1]
    system.events.add(EventKind.CALIBRATED, 74, 7.4, later, lost=[lost])
    system.finish()
    (event,) = system.events.of_kind(EventKind.REGISTERED)
    assert (event.submap, event.data["old_submaps"]) == (later, [lost])
