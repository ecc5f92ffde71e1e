"""A map that the images disagree with is ended where that began, and what it posed since has no pose of it."""

from __future__ import annotations

import numpy as np

from dualslam.core.events import EventKind
from dualslam.core.types import FloatArray, View
from dualslam.map.submap import Submap
from dualslam.run.judgement import judge_run
from dualslam.run.results import frame_rows, trajectories_of
from dualslam.system.audit.photometric import MIN_SAMPLES
from dualslam.system.system import System
from dualslam.testing.point_world import PointWorld, cloud, hand_held, pose_errors, system_in

N, WRONG = 90, range(41, 60)
"""Frames, at 20 a second, and those that the images contradict."""


class Script:
    """Disagrees with frames of the first map."""

    def remember(self, submap: Submap, view: View) -> None:
        pass

    def measure(self, submap: Submap, view: View, T_cam_submap: FloatArray) -> float | None:
        return 0.02 if view.index in WRONG and submap.id == 0 else 0.8


def run() -> tuple[System, PointWorld]:
    world = PointWorld(cloud(), hand_held(N))
    system = system_in(world)
    system.audit._patches = Script()
    for frame in world.frames():
        system.step(frame)
    system.finish()
    return system, world


def test_a_map_that_the_images_contradict_ends_there_and_recovers() -> None:
    system, world = run()
    (failed,) = system.events.of_kind(EventKind.FAILED)
    assert failed.data["reason"] == "photometric"
    assert WRONG[0] < failed.frame <= WRONG[0] + 4 * MIN_SAMPLES
    assert failed.data["suspected_since"] <= WRONG[0]
    assert len(system.atlas.submaps) == 2
    own = [i for i, pose in system.poses.items() if pose.submap_id == 0]
    assert max(own) < WRONG[0], "what it posed since is not its any more"
    trajectories = trajectories_of(system)
    translation, _ = pose_errors(trajectories.main.T_world_cam, world.T_world_cam[trajectories.main.index])
    assert np.median(translation) < 0.06
    verdict = judge_run(system, trajectories, frame_rows(system, trajectories.main))
    assert "photometric" not in [reason.code for reason in verdict.reasons]
