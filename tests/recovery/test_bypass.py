"""A lost map that no link joins, and a new one that has posed all its frames."""

from __future__ import annotations

import pytest

from dualslam.core.events import EventKind
from dualslam.core.types import FrameStatus
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
def test_a_lost_map_gives_its_frames_to_a_larger_one_that_has_posed_them_all() -> None:
    system, world = run(110)
    (archived,) = system.events.of_kind(EventKind.ARCHIVED)
    (event,) = system.events.of_kind(EventKind.ABSORBED)
    assert 50 + 35 <= event.frame < 50 + 35 + 10, "with the first keyframe after it has outgrown the lost one"
    system.finish()
    assert (event.submap, event.data["old_submaps"], event.data["frames"]) == (1, [0], 35)
    main = trajectories_of(system).main
    assert main.index.tolist() == [i for i in range(110) if i not in COVERED]
    translation, rotation = pose_errors(main.T_world_cam, world.T_world_cam[main.index])
    assert translation.max() < POSITION_M
    assert rotation.max() < ROTATION_RAD
    rows = frame_rows(system, main)
    assert all(row.status is FrameStatus.BYPASSED and row.submap == 1 for row in rows[:35])
    assert len(system.atlas.submaps[0].keyframes) == archived.data["keyframes"]  # as it was
    assert not system.atlas.links


@pytest.mark.slow
def test_a_lost_map_that_holds_more_than_the_new_one_keeps_its_frames_until_the_run_ends() -> None:
    system, world = run(75)
    ended = system.events.of_kind(EventKind.RECOVERY_ENDED)
    assert ended[-1].data["frames"] >= 35  # the walk has been over all of it
    assert not system.events.of_kind(EventKind.ABSORBED)
    system.finish()
    (absorbed,) = system.events.of_kind(EventKind.ABSORBED)
    assert absorbed.data["frames"] == 35
    main = trajectories_of(system).main
    assert main.index.tolist() == [i for i in range(75) if i not in COVERED]
    translation, rotation = pose_errors(main.T_world_cam, world.T_world_cam[main.index])
    assert translation.max() < POSITION_M
    assert rotation.max() < ROTATION_RAD


@pytest.mark.slow
def test_frames_of_a_lost_map_that_the_walk_has_not_posed_are_registered_at_the_end() -> None:
    system, world = run(110, buffer={"duration_s": 3.5})  # the oldest frames are forgotten by then
    system.finish()
    assert len(system.events.of_kind(EventKind.RECOVERY_ENDED)) == 2
    assert not system.events.of_kind(EventKind.ABSORBED)
    assert system.events.of_kind(EventKind.REGISTERED)
    main = trajectories_of(system).main
    assert main.index.tolist() == [i for i in range(110) if i not in COVERED]
    translation, rotation = pose_errors(main.T_world_cam, world.T_world_cam[main.index])
    assert translation.max() < POSITION_M
    assert rotation.max() < ROTATION_RAD
