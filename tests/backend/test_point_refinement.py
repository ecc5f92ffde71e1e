from __future__ import annotations

import numpy as np

from dualslam.backend.observability import projection_jacobian
from dualslam.backend.point_refinement import refine_points
from dualslam.core.geometry import se3
from dualslam.testing.graph_scene import K

N_VIEWS, N_POINTS = 6, 300


def scene(noise_px: float, seed: int = 0):
    """Cameras on a line look at points 2 to 4 ahead."""
    rng = np.random.default_rng(seed)
    T = np.array([se3.exp([*(0.05 * rng.normal(size=3)), 0.2 * i, 0.0, 0.0]) for i in range(N_VIEWS)])
    xyz = rng.uniform([-0.5, -0.5, 2.0], [1.5, 0.5, 4.0], (N_POINTS, 3))
    pose, point = (a.ravel() for a in np.meshgrid(np.arange(N_VIEWS), np.arange(N_POINTS), indexing="ij"))
    cam = np.einsum("rji,rj->ri", T[pose, :3, :3], xyz[point] - T[pose, :3, 3])
    sigma = rng.choice([1.0, 1.2], len(pose))
    uv = (
        cam[:, :2] / cam[:, 2:] * [K[0, 0], K[1, 1]]
        + K[:2, 2]
        + noise_px * sigma[:, None] * rng.normal(size=(len(pose), 2))
    )
    return T, xyz, pose, point, uv, sigma


def test_derivative_against_a_numerical_one() -> None:
    T, xyz, pose, point, _, sigma = scene(0.0)

    def project(x):
        cam = np.einsum("rji,rj->ri", T[pose, :3, :3], x[point] - T[pose, :3, 3])
        return cam, (cam[:, :2] / cam[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2]) / sigma[:, None]

    J = projection_jacobian(K, T[pose, :3, :3], project(xyz)[0], sigma)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        numerical = (project(xyz + step)[1] - project(xyz - step)[1]) / 2e-6
        np.testing.assert_allclose(J[:, axis].T, numerical, rtol=1e-5, atol=1e-4)


def test_points_find_their_place_whatever_an_outlier_says() -> None:
    """One view of six: two that err alike outvote what Huber's weight leaves the others."""
    T, xyz, pose, point, uv, sigma = scene(0.3)
    rng = np.random.default_rng(1)
    wrong = rng.permutation(len(uv))
    wrong = wrong[np.unique(point[wrong], return_index=True)[1]][: N_POINTS // 4]
    uv[wrong] += 15.0
    start = xyz + 0.02 * rng.normal(size=xyz.shape)
    found = refine_points(K, T, pose, start, point, uv, sigma, 1.345)
    before, after = (np.linalg.norm(x - xyz, axis=1) for x in (start, found))
    assert np.median(after) < 0.2 * np.median(before)
    assert (after < 2 * before + 0.03).all()


def test_a_point_that_would_not_gain_stays() -> None:
    T, xyz, pose, point, uv, sigma = scene(0.0)
    behind = xyz.copy()
    behind[0, 2] = -1.0
    found = refine_points(K, T, pose, behind, point, uv, sigma, 1.345)
    np.testing.assert_array_equal(found[0], behind[0])
    np.testing.assert_allclose(found[1:], xyz[1:], atol=1e-6)
