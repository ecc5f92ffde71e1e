"""Who may enter a graph."""

from __future__ import annotations

import numpy as np

from dualslam.backend.observability import compute_depth_sigmas, compute_residuals, find_components, numbered

K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])


def two_cameras(baseline):
    T = np.array([np.eye(4)] * 2)
    T[1, 0, 3] = baseline
    return T


def test_residuals_and_points_behind():
    T = two_cameras(0.1)
    xyz = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    uv = np.array([[323.0, 244.0], [320.0, 240.0]])
    res = compute_residuals(K, T, np.array([0, 0]), xyz, uv, np.array([2.0, 1.0]))
    np.testing.assert_allclose(res.chi2, [25 / 4, np.inf])
    np.testing.assert_allclose(res.depth_mu, [1.0, -1.0])


def test_depth_sigma_is_that_of_triangulation():
    for baseline in (0.05, 0.2):
        T = two_cameras(baseline)
        pose, point = np.array([0, 1]), np.array([0, 0])
        cam = np.array([[0.0, 0.0, 2.0], [-baseline, 0.0, 2.0]])
        sigma = compute_depth_sigmas(K, T, pose, cam, np.ones(2), point, 1)[0]
        expected = np.sqrt(2) * 2.0 / (500 * baseline)  # sigma_z / z = sqrt(2) z / (f b) at 1 px
        assert abs(sigma / expected - 1) < 0.05


def test_one_view_or_no_parallax_is_never_certain():
    T = two_cameras(0.0)
    cam = np.array([[0.1, 0.2, 2.0], [0.1, 0.2, 2.0], [0.0, 0.0, 1.0]])
    sigmas = compute_depth_sigmas(K, T, np.array([0, 1, 0]), cam, np.ones(3), np.array([0, 0, 1]), 3)
    assert sigmas[0] > 1e3
    assert np.isinf(sigmas[1])
    assert np.isinf(sigmas[2])


def test_numbered_is_unique_with_its_inverse():
    for values in (np.array([7, 3, 3, 900, 0, 7]), np.zeros(0, np.int64)):
        ids, place = numbered(values)
        np.testing.assert_array_equal(ids, np.unique(values))
        np.testing.assert_array_equal(ids[place], values)


def test_components_of_chains_and_islands():
    # 0-1-2-...-99 by shared landmarks, 200-201 apart, 300 alone.
    kf = np.concatenate([np.arange(99), np.arange(1, 100), [200, 201, 300]])
    lm = np.concatenate([np.arange(99), np.arange(99), [500, 500, 600]])
    shuffle = np.random.default_rng(0).permutation(len(kf))
    ids, label = find_components(kf[shuffle], lm[shuffle])
    assert len(set(label[:100].tolist())) == 1
    assert label[ids == 200] == label[ids == 201]
    assert len(set(label.tolist())) == 3
