"""A frame's pose against landmarks that two noisy views have placed."""

from __future__ import annotations

from typing import Any

import numpy as np

from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import project_points, refine_pose
from dualslam.core.geometry.triangulation import triangulate_two_view
from dualslam.core.types import FloatArray, Keyframe
from dualslam.frontends.tracking.landmark_noise import refine_with_landmarks
from dualslam.map.submap import Submap
from dualslam.testing.point_world import CAMERA, make_features

N_POINTS, N_TRIALS, SIGMA_PX = 150, 40, 1.0


def at(x: float) -> FloatArray:
    return se3.from_parts(np.eye(3), np.array([x, 0.0, 0.0]))


def lengths(seed: int) -> tuple[float, float, int]:
    """Return how long the way to a frame is found to be, for 1, and how many more landmarks agree with the second.

    First against landmarks taken for exact, then together with them.
    """
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-3, -3, 4], [4, 3, 12], (N_POINTS, 3))
    sigma, octave = np.full(N_POINTS, SIGMA_PX), np.zeros(N_POINTS, np.int64)
    words = rng.integers(0, 256, (N_POINTS, 32), np.uint8)

    def features(x: float) -> Any:
        uv = project_points(CAMERA.K, se3.inverse(at(x)), xyz)[0]
        return make_features(uv + SIGMA_PX * rng.normal(size=uv.shape), sigma, octave, words)

    a, b, frame = features(0.0), features(0.4), features(1.0)
    submap = Submap(0, CAMERA.K, words[0])
    placed = triangulate_two_view(a.uv_rect_px, b.uv_rect_px, CAMERA.K, at(0.0), at(0.4)).xyz
    for k, (x, seen) in enumerate([(0.0, a), (0.4, b)]):
        submap.add_keyframe(Keyframe(k, float(k), seen), at(x))
    ids = submap.add_landmarks(placed, words, np.ones(N_POINTS), 0)
    for k in (0, 1):
        submap.add_observations(k, np.arange(N_POINTS), ids)
    exact: Any = refine_pose(CAMERA.K, se3.inverse(at(1.0)), placed, frame.uv_rect_px, sigma)
    together = refine_with_landmarks(submap, ids, exact, frame.uv_rect_px, sigma, np.ones(N_POINTS, np.bool_))
    first, second = (float(se3.inverse(pose.T_cam_w)[0, 3]) for pose in (exact, together))
    return first, second, together.n_inliers - exact.n_inliers


def test_poses_are_not_too_short_because_landmarks_are_noisy() -> None:
    exact, together, gained = np.array([lengths(seed) for seed in range(N_TRIALS)]).T
    of_the_mean = together.std() / np.sqrt(N_TRIALS)
    assert abs(together.mean() - 1) < 3 * of_the_mean
    assert exact.mean() - 1 < -6 * of_the_mean  # which is why
    assert (gained > 0).all()
