"""The covariance of a frame's pose: as large as the pose's errors are."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from dualslam.backend.local_ba import bundle_adjust
from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import refine_pose
from dualslam.lab.metrics.pose_consistency import pose_nees
from dualslam.system.pose_covariance import PoseCovariance
from dualslam.testing.graph_scene import Feeder, K, make_scene
from dualslam.testing.point_world import PointWorld, cloud, hand_held, system_in

N_KEYFRAMES = 6
GAUGE = (0, 2)
N_WORLDS = 24


def nees_of(seed: int) -> tuple[float, float]:
    """NEES of the last keyframe, and of a frame that is tracked against the adjusted landmarks."""
    scene = make_scene(N_KEYFRAMES + 1, 80, 1.0, seed)
    feeder = Feeder(scene, seed)
    for k in range(N_KEYFRAMES):
        feeder.add(k)
    submap = feeder.submap
    submap.gauge = GAUGE
    submap.apply_estimate(*bundle_adjust(submap, list(range(1, N_KEYFRAMES)), [0], robust_k=1e3).estimate)
    landmark = feeder.landmark_of_point[scene.seen[N_KEYFRAMES]]
    seen, features = np.flatnonzero(landmark >= 0), scene.features[N_KEYFRAMES]
    ids, uv, sigma = landmark[seen], features.uv_px[seen], features.sigma_px[seen]
    guess = submap.T_submap_kf[N_KEYFRAMES - 1] @ se3.inverse(scene.T_true[-2]) @ scene.T_true[-1]
    tracked: Any = refine_pose(K, se3.inverse(guess), submap.landmarks["xyz_mu"][ids], uv, sigma)
    ids, sigma = ids[tracked.inliers], sigma[tracked.inliers]
    poses = {N_KEYFRAMES - 1: submap.T_submap_kf[N_KEYFRAMES - 1], N_KEYFRAMES: se3.inverse(tracked.T_cam_w)}
    found = []
    for k, T in poses.items():
        covariance = PoseCovariance(submap, k, T, ids, sigma)()
        result: Any = SimpleNamespace(T_submap_cam=T, covariance=covariance, submap_id=0, index=k)
        found.append(pose_nees({0: submap}, result, scene.T_true))
    return found[0], found[1]


def test_errors_are_as_large_as_is_said() -> None:
    """Six are expected, 0.7 is the standard deviation of the mean."""
    mean = np.mean([nees_of(seed) for seed in range(N_WORLDS)], axis=0)
    assert (np.abs(mean - 6.0) < 2.0).all()


def test_fewer_landmarks_leave_a_pose_less_sure() -> None:
    world = PointWorld(cloud(), hand_held(30))
    system = system_in(world)
    for frame in world.frames():
        result = system.step(frame)
        assert (result.covariance_now is None) == (result.T_submap_cam is None)
    whole = result.covariance_now
    assert whole is not None
    assert np.allclose(whole(), whole().T)
    part = replace(whole, landmark_ids=whole.landmark_ids[:20], sigma_px=whole.sigma_px[:20])
    assert np.trace(part()) > 1.2 * np.trace(whole())
    none = replace(whole, landmark_ids=whole.landmark_ids[:2], sigma_px=whole.sigma_px[:2])
    assert none() is None
