"""The covariance of a frame's pose, live: as large as the pose's errors are."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.core.chi_square import MEDIAN_CHI2
from dualslam.core.geometry import se3
from dualslam.testing.point_world import PointWorld, cloud, hand_held, system_in

N = 60
SEEDS = (40, 41, 42, 43)
"""None of those by which the inflation was found, 10 to 39."""


def normalised_errors(seed: int, n: int = N) -> np.ndarray:
    """NEES of all frames after a map's start, each when it was posed, in the gauge of its submap."""
    world = PointWorld(cloud(seed=seed), hand_held(n), seed=seed)
    system = system_in(world)
    nees = []
    for frame in world.frames():
        result = system.step(frame)
        if result.T_submap_cam is None:
            assert result.covariance is None
            continue
        submap = system.atlas.submaps[result.submap_id]
        first, second = submap.gauge
        if frame.index <= second or second not in submap.keyframes:
            continue
        covariance = result.covariance
        assert covariance is not None
        assert covariance == pytest.approx(covariance.T)
        T = se3.inverse(world.T_world_cam[first]) @ world.T_world_cam
        unit = np.linalg.norm(submap.T_submap_kf[second][:3, 3] - submap.T_submap_kf[first][:3, 3])
        T[:, :3, 3] *= unit / np.linalg.norm(T[second, :3, 3])
        estimated = se3.inverse(submap.T_submap_kf[first]) @ result.T_submap_cam
        error = se3.log(se3.inverse(T[frame.index]) @ estimated)
        nees.append(error @ np.linalg.solve(covariance, error))
    return np.array(nees)


def test_errors_of_live_poses_are_as_large_as_is_said() -> None:
    """The median, within a factor of two: frames of one run share their errors, and one bad run rules a mean."""
    nees = np.concatenate([normalised_errors(seed) for seed in SEEDS])
    assert len(nees) > 3 * N
    assert 0.5 * MEDIAN_CHI2[6] < np.median(nees) < 2.0 * MEDIAN_CHI2[6]


def test_fewer_landmarks_leave_a_pose_less_sure() -> None:
    world = PointWorld(cloud(), hand_held(30))
    system = system_in(world)
    for frame in world.frames():
        result = system.step(frame)
    whole = result.covariance_now
    assert whole is not None
    part = type(whole)(
        whole.submap,
        whole.graph,
        whole.keyframe_id,
        whole.T_submap_cam,
        whole.landmark_ids[:20],
        whole.sigma_px[:20],
    )
    assert np.trace(part()) > 2 * np.trace(whole())
    none = type(whole)(
        whole.submap, whole.graph, whole.keyframe_id, whole.T_submap_cam, whole.landmark_ids[:2], whole.sigma_px[:2]
    )
    assert none() is None
