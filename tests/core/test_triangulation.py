"""Triangulation: exact on exact data, minimal in reprojection error on noisy data, honest about what it cannot see."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import project_points, projection_jacobians
from dualslam.core.geometry.triangulation import in_front, point_covariance, triangulate_n_view, triangulate_two_view
from dualslam.testing.two_maps import K, two_views

EXACT = 1e-9
EXCESS_PX2 = 1e-6


def reprojection2(poses: np.ndarray, point: np.ndarray, uv: np.ndarray) -> float:
    """Return the summed squared error of one point in V views (T_cam_w, (V, 2))."""
    return float(
        sum(((project_points(K, T, point[None])[0][0] - m) ** 2).sum() for T, m in zip(poses, uv, strict=True))
    )


def test_two_views_exact() -> None:
    """Points, depths and parallax come back; errors are zero."""
    v = two_views(0)
    points = triangulate_two_view(v.uv_a, v.uv_b, K, v.T_w_a, v.T_w_b)
    np.testing.assert_allclose(points.xyz, v.xyz, atol=EXACT)
    np.testing.assert_allclose(points.depth_a, se3.act(se3.inverse(v.T_w_a), v.xyz)[:, 2], atol=EXACT)
    np.testing.assert_allclose(points.depth_b, se3.act(se3.inverse(v.T_w_b), v.xyz)[:, 2], atol=EXACT)
    rays = [(v.xyz - T[:3, 3]) / np.linalg.norm(v.xyz - T[:3, 3], axis=1)[:, None] for T in (v.T_w_a, v.T_w_b)]
    np.testing.assert_allclose(points.cos_parallax, (rays[0] * rays[1]).sum(1), atol=1e-12)
    assert max(points.error2_a.max(), points.error2_b.max()) < 1e-15
    assert in_front(points.depth_a, points.depth_b).all()


def test_two_views_minimise_the_reprojection_error() -> None:
    """With 2 px of noise no neighbour is better, and SciPy from the truth finds nothing lower."""
    v = two_views(1, 30)
    rng = np.random.default_rng(1)
    uv_a, uv_b = v.uv_a + 2 * rng.normal(size=v.uv_a.shape), v.uv_b + 2 * rng.normal(size=v.uv_b.shape)
    points = triangulate_two_view(uv_a, uv_b, K, v.T_w_a, v.T_w_b)
    poses = se3.inverse(np.stack([v.T_w_a, v.T_w_b]))
    for i in range(len(uv_a)):
        uv = np.stack([uv_a[i], uv_b[i]])
        ours = points.error2_a[i] + points.error2_b[i]
        if points.depth_a[i] > 0:
            assert abs(ours - reprojection2(poses, points.xyz[i], uv)) < 1e-9

        def residual(ray: np.ndarray, uv: np.ndarray = uv) -> np.ndarray:
            p = se3.act(v.T_w_a, np.array([ray[0], ray[1], 1.0]) / ray[2])
            return np.concatenate([project_points(K, T, p[None])[0][0] - m for T, m in zip(poses, uv, strict=True)])

        truth = se3.act(se3.inverse(v.T_w_a), v.xyz[i])
        best = least_squares(residual, np.append(truth[:2], 1.0) / truth[2], xtol=1e-15, ftol=1e-15, gtol=1e-15)
        assert ours < 2 * best.cost + EXCESS_PX2


def test_crossing_and_diverging_rays() -> None:
    """A point behind both cameras has negative depths; parallel rays end far away, finite."""
    uv = np.array([[600.0, 180.0]])
    T_w_b = se3.from_parts(np.eye(3), np.array([1.0, 0.0, 0.0]))
    diverging = triangulate_two_view(uv, uv + [[50.0, 0.0]], K, np.eye(4), T_w_b)
    assert not in_front(diverging.depth_a, diverging.depth_b)[0]
    parallel = triangulate_two_view(uv, uv, K, np.eye(4), T_w_b)
    assert np.isfinite(parallel.xyz).all()
    assert parallel.depth_a[0] > 1e9
    assert parallel.cos_parallax[0] > np.cos(1e-6)


def test_identical_poses_do_not_crash() -> None:
    """No baseline: finite numbers, no parallax."""
    v = two_views(2, 5)
    points = triangulate_two_view(v.uv_a, v.uv_a, K, v.T_w_a, v.T_w_a)
    assert not np.isnan(points.xyz).any()
    assert (points.cos_parallax > np.cos(1e-4)).all()


def five_views(seed: int, n: int = 60) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (T_cam_w (5, 4, 4), xyz, uv (N, 5, 2)), exact."""
    v = two_views(seed, n)
    rng = np.random.default_rng(seed)
    T_w_cam = v.T_w_a @ se3.exp(np.hstack([0.03 * rng.normal(size=(5, 3)), 0.4 * rng.normal(size=(5, 3))]))
    T_cam_w = se3.inverse(T_w_cam)
    return T_cam_w, v.xyz, np.stack([project_points(K, T, v.xyz)[0] for T in T_cam_w], 1)


def test_n_views_exact_with_gaps() -> None:
    """Any two or more views give the point; fewer give NaN; hidden pixels may hold anything."""
    T_cam_w, xyz, uv = five_views(3)
    visible = np.random.default_rng(3).random(uv.shape[:2]) < 0.5
    uv[~visible] = np.nan
    points = triangulate_n_view(uv, K, T_cam_w, visible)
    enough = visible.sum(1) >= 2
    assert 0 < enough.sum() < len(xyz)
    np.testing.assert_allclose(points.xyz[enough], xyz[enough], atol=1e-6)
    assert np.isnan(points.xyz[~enough]).all()
    assert (np.isnan(points.error2) == (~visible | ~enough[:, None])).all()
    assert (points.min_cos_parallax[~enough] == 1.0).all()


def test_views_that_do_not_see_a_point_make_no_difference() -> None:
    """Each point of many views is where its own two views alone place it, and its numbers stand under these."""
    T_cam_w, _, uv = five_views(5)
    rng = np.random.default_rng(5)
    uv = uv + 0.5 * rng.normal(size=uv.shape)
    views = np.sort(np.argsort(rng.random(uv.shape[:2]), axis=1)[:, :2], axis=1)
    visible = np.zeros(uv.shape[:2], bool)
    np.put_along_axis(visible, views, True, 1)
    points = triangulate_n_view(uv, K, T_cam_w, visible)
    for i, own in enumerate(views):
        alone = triangulate_n_view(uv[i : i + 1, own], K, T_cam_w[own])
        np.testing.assert_allclose(points.xyz[i], alone.xyz[0], rtol=1e-8)
        np.testing.assert_allclose(points.depth[i, own], alone.depth[0], rtol=1e-8)
        np.testing.assert_allclose(points.error2[i, own], alone.error2[0], rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(points.min_cos_parallax[i], alone.min_cos_parallax[0], rtol=1e-12)
    assert np.isnan(points.depth[~visible]).all()


def test_n_views_minimise_the_reprojection_error() -> None:
    """With noise: SciPy finds nothing lower, and two views agree with the two-view function."""
    T_cam_w, xyz, uv = five_views(4)
    uv = uv + np.random.default_rng(4).normal(size=uv.shape)
    points = triangulate_n_view(uv, K, T_cam_w)
    for i in range(0, len(xyz), 6):

        def residual(p: np.ndarray, i: int = i) -> np.ndarray:
            return np.concatenate(
                [project_points(K, T, p[None])[0][0] - m for T, m in zip(T_cam_w, uv[i], strict=True)]
            )

        best = least_squares(residual, xyz[i], xtol=1e-15, ftol=1e-15, gtol=1e-15)
        assert points.error2[i].sum() < 2 * best.cost + EXCESS_PX2
    pair = triangulate_n_view(uv[:, :2], K, T_cam_w[:2])
    two = triangulate_two_view(uv[:, 0], uv[:, 1], K, *se3.inverse(T_cam_w[:2]))
    np.testing.assert_allclose(pair.error2.sum(1), two.error2_a + two.error2_b, atol=EXCESS_PX2)
    np.testing.assert_allclose(pair.min_cos_parallax, two.cos_parallax, atol=1e-12)


def test_masks() -> None:
    """Hidden views do not count against cheirality."""
    depth = np.array([[1.0, np.nan], [1.0, -1.0]])
    np.testing.assert_array_equal(in_front(depth), [True, False])


def test_point_covariance_is_the_inverse_information() -> None:
    """Ragged observations in any order, against a loop over points."""
    T_cam_w, xyz, _ = five_views(5, 20)
    rng = np.random.default_rng(5)
    visible = rng.random((20, 5)) < 0.6
    visible[:, :2] = True
    visible[7] = [True, False, False, False, False]
    index, view = (a[rng.permutation(visible.sum())] for a in np.nonzero(visible))
    order = rng.permutation(visible.sum())
    index, view = (a[order] for a in np.nonzero(visible))
    sigma = rng.uniform(0.5, 2.0, len(index))
    covariance = point_covariance(xyz, K, index, T_cam_w[view], sigma)
    assert np.isnan(covariance[7]).all()
    for j in np.delete(np.arange(20), 7):
        H = np.zeros((3, 3))
        for o in np.flatnonzero(index == j):
            J = projection_jacobians(K, T_cam_w[view[o]], xyz[j : j + 1])[1][0]
            H += J.T @ J / sigma[o] ** 2
        np.testing.assert_allclose(covariance[j], np.linalg.inv(H), rtol=1e-6, atol=1e-9 * np.trace(np.linalg.inv(H)))


def test_point_covariance_predicts_the_scatter() -> None:
    """Over many noisy triangulations of near points the normalised squared error is chi-square with 3 dof."""
    T_cam_w, xyz, uv = five_views(6, 40)
    rng = np.random.default_rng(6)
    covariance = point_covariance(xyz, K, np.repeat(np.arange(40), 5), np.tile(T_cam_w, (40, 1, 1)), np.full(200, 0.3))
    squared = []
    for _ in range(30):
        error = triangulate_n_view(uv + 0.3 * rng.normal(size=uv.shape), K, T_cam_w).xyz - xyz
        squared.append((error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(1))
    assert abs(np.mean(squared) - 3.0) < 3 * np.sqrt(6.0 / np.size(squared)) + 0.05


@pytest.mark.parametrize("case", ["behind", "same centre", "unseen"])
def test_point_covariance_is_nan_where_unknown(case: str) -> None:
    """Not a large number: NaN, which no gate accepts."""
    T_cam_w, xyz, _ = five_views(7, 3)
    index, poses = np.array([0, 0]), T_cam_w[:2]
    if case == "behind":
        xyz = se3.act(se3.inverse(T_cam_w[0]), np.array([[0.0, 0.0, -3.0]]))
    elif case == "same centre":
        poses = T_cam_w[[0, 0]]
    else:
        index = np.array([1, 1])
    assert np.isnan(point_covariance(xyz, K, index, poses, np.ones(2))[0]).all()
