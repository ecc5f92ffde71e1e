"""What a pose beyond a gap is worth: against the whole of the normal equations, and against errors that were made."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import projection_jacobians, refine_pose
from dualslam.core.types import FloatArray
from dualslam.frontends.gap.uncertainty import HESSIAN_INFLATION, gap_uncertainty, pose_uncertainty
from dualslam.testing.point_world import PointWorld, cloud, hand_held
from tests.frontends.tracking.test_tracking import true_map

K = np.array([[400.0, 0.0, 320.0], [0.0, 400.0, 240.0], [0.0, 0.0, 1.0]])
N = 40


def points(seed: int = 0) -> FloatArray:
    rng = np.random.default_rng(seed)
    return rng.uniform([-2, -1.5, 4], [2, 1.5, 9], (N, 3))


def information(xyz: FloatArray, baseline: float) -> FloatArray:
    """What two cameras side by side know of points, a pixel of noise each."""
    H = np.zeros((len(xyz), 3, 3))
    for x in (0.0, baseline):
        T = se3.exp(np.array([0, 0, 0, -x, 0, 0]))
        _, J = projection_jacobians(K, T, xyz)
        H += J.swapaxes(1, 2) @ J
    return H


def test_it_is_what_the_whole_of_the_normal_equations_says() -> None:
    xyz, sigma = points(), np.linspace(0.5, 2.0, N)
    T = se3.exp(np.array([0.02, -0.05, 0.01, 0.3, -0.1, 1.0]))
    H_known = information(xyz, 0.5)
    covariance, scale_sigma = gap_uncertainty(K, T, xyz, sigma, H_known)
    J_pose, J_point = projection_jacobians(K, T, xyz)
    H = np.zeros((6 + 3 * N, 6 + 3 * N))
    for n in range(N):
        J = np.zeros((2, len(H)))
        J[:, :6], J[:, 6 + 3 * n : 9 + 3 * n] = J_pose[n], J_point[n]
        H += J.T @ J / sigma[n] ** 2
        H[6 + 3 * n : 9 + 3 * n, 6 + 3 * n : 9 + 3 * n] += H_known[n]
    P = np.linalg.inv(H) * HESSIAN_INFLATION**2
    np.testing.assert_allclose(covariance, P[:6, :6], rtol=1e-6, atol=1e-12)
    # The mean log depth, weighted as it likes: no weights can make it less certain than the least certain point, or
    # more certain than the pose's own error along the axis allows.
    depth = (xyz @ T[:3, :3].T + T[:3, 3])[:, 2]
    single = []
    for n in range(N):
        g = np.zeros(len(H))
        p = T[:3, :3] @ xyz[n] + T[:3, 3]
        g[:6] = np.array([p[1], -p[0], 0, 0, 0, 1]) / depth[n]
        g[6 + 3 * n : 9 + 3 * n] = T[2, :3] / depth[n]
        single.append(np.sqrt(g @ P @ g))
    assert scale_sigma < max(single)
    assert scale_sigma > 0.1 * min(single)


@pytest.mark.parametrize("baseline", [0.2, 1.0])
def test_the_scale_is_off_by_what_it_says(baseline: float) -> None:
    """Points placed with the noise that two cameras leave, a third camera posed by them, many times over."""
    xyz, rng, T = points(), np.random.default_rng(1), se3.exp(np.array([0.0, 0.03, 0.0, 0.0, 0.0, 1.0]))
    H_known = information(xyz, baseline)
    half = np.linalg.cholesky(np.linalg.inv(H_known))
    uv = (xyz @ T[:3, :3].T + T[:3, 3]) @ K.T
    uv = uv[:, :2] / uv[:, 2:]
    _, claimed = gap_uncertainty(K, T, xyz, np.ones(N), H_known)
    off = []
    for _ in range(150):
        noisy = xyz + np.einsum("nij,nj->ni", half, rng.normal(size=(N, 3)))
        found = refine_pose(K, T, noisy, uv + rng.normal(size=(N, 2)), np.full(N, 20.0))  # no outliers to be found
        assert found
        depth, true = (noisy @ found.T_cam_w[2, :3] + found.T_cam_w[2, 3]), (xyz @ T[2, :3] + T[2, 3])
        off.append(np.median(np.log(depth / true)))
    # A pose by points taken for exact, and their plain median, are no better than the best of both, nor worse by far.
    assert 0.5 < np.std(off) / (claimed / HESSIAN_INFLATION) < 3.0


def test_landmarks_that_are_hardly_known_leave_the_scale_open() -> None:
    world = PointWorld(cloud(), hand_held(80))
    T_cam = se3.inverse(world.T_world_cam[30])
    sigmas = []
    for keyframes in ([0, 1], [0, 4, 8], [0, 4, 8, 12, 16]):
        submap = true_map(world, keyframes)
        ids = np.flatnonzero(submap.landmarks["alive"])
        ids = ids[submap.depths(ids, T_cam) > 0]
        known = pose_uncertainty(submap, T_cam, ids, np.ones(len(ids)))
        assert known is not None
        sigmas.append(known[1])
    assert sigmas[0] > sigmas[1] > sigmas[2]
    assert pose_uncertainty(submap, T_cam, ids[:3], np.ones(3)) is None
