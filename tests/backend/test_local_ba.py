"""Bundle adjustment of arrays and of a submap's window."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dualslam.backend.local_ba import BundleProblem, bundle_adjust, bundle_adjust_arrays
from dualslam.testing.graph_scene import Feeder, K, make_scene, pose_errors


def make_problem(n=8, noise_px=0.0, seed=0, n_fixed=2):
    scene = make_scene(n, 100, noise_px, seed)
    feeder = Feeder(scene)
    for k in range(n):
        feeder.add(k, exact=True)
    obs = feeder.submap.observations
    uv, sigma = feeder.submap.observed_pixels(np.arange(len(obs)))
    T = scene.T_true.copy()
    T[n_fixed:, :3, 3] += 0.01 * np.random.default_rng(seed).normal(size=(n - n_fixed, 3))
    xyz = feeder.submap.landmarks["xyz_mu"].copy()
    fixed = np.arange(n) < n_fixed
    return scene, feeder, BundleProblem(K, T, fixed, xyz, obs["kf"].copy(), obs["landmark"].copy(), uv, sigma)


def test_exact_pixels_lead_back_to_the_truth():
    scene, feeder, problem = make_problem()
    result = bundle_adjust_arrays(problem, max_iterations=30, tolerance=1e-10)
    t, r = pose_errors(result.T_submap_kf, scene.T_true)
    assert t.max() < 1e-5
    assert r.max() < 1e-5
    truth = scene.xyz_true[feeder.point_of_landmark()]
    assert np.median(np.linalg.norm(result.xyz_mu - truth, axis=1)[result.adjusted]) < 1e-5
    assert result.cost_after < 1e-4 < result.cost_before
    np.testing.assert_array_equal(result.T_submap_kf[:2], problem.T_submap_kf[:2])


def test_noise_and_outliers():
    scene, _, problem = make_problem(noise_px=1.0)
    rng = np.random.default_rng(1)
    bad = rng.permutation(len(problem.kf))[: len(problem.kf) // 15]
    problem.uv_px[bad] += rng.choice([-1, 1], (len(bad), 2)) * rng.uniform(15, 40, (len(bad), 2))
    result = bundle_adjust_arrays(problem, max_iterations=20)
    t, _ = pose_errors(result.T_submap_kf, scene.T_true)
    assert t.max() < 0.02
    assert np.median(result.chi2[bad]) > 50
    good = np.setdiff1d(np.arange(len(problem.kf)), bad)
    assert np.median(result.chi2[good]) < 2.0


def test_degenerate_points_stay_where_they_are():
    _, _, problem = make_problem()
    j = len(problem.xyz_mu)
    T = problem.T_submap_kf[3]
    behind, lonely = T[:3, 3] - T[:3, 2], T[:3, 3] + T[:3, 2]
    unseen = np.zeros(3)
    problem = replace(
        problem,
        xyz_mu=np.vstack([problem.xyz_mu, behind, lonely, unseen]),
        kf=np.append(problem.kf, [3, 4, 3]),
        point=np.append(problem.point, [j, j, j + 1]),
        uv_px=np.vstack([problem.uv_px, [[600.0, 190.0]] * 3]),
        sigma_px=np.append(problem.sigma_px, [1.0] * 3),
    )
    result = bundle_adjust_arrays(problem)
    assert not result.adjusted[j:].any()
    np.testing.assert_array_equal(result.xyz_mu[j:], problem.xyz_mu[j:])
    assert np.isinf(result.chi2[-3:-1]).all()


def test_nothing_to_adjust():
    _, _, problem = make_problem()
    none = np.zeros(0, np.int64)
    empty = replace(problem, kf=none, point=none, uv_px=np.zeros((0, 2)), sigma_px=np.zeros(0))
    result = bundle_adjust_arrays(empty)
    np.testing.assert_array_equal(result.T_submap_kf, problem.T_submap_kf)


def test_no_fixed_pose_is_borne():
    _, _, problem = make_problem(noise_px=0.5)
    result = bundle_adjust_arrays(replace(problem, fixed=np.zeros(8, bool)))
    assert result.cost_after < 0.2 * result.cost_before


def test_window_of_a_submap():
    scene = make_scene(16, 100, 0.5, 2)
    feeder = Feeder(scene, point_noise=0.02)
    for k in range(16):
        feeder.add(k, exact=True)
    submap = feeder.submap
    before = {k: T.copy() for k, T in submap.T_submap_kf.items()}
    bundle = bundle_adjust(submap, [12, 10, 11])
    assert bundle.keyframe_ids[:3].tolist() == [12, 10, 11]
    assert len(bundle.keyframe_ids) > 6
    assert all(np.array_equal(submap.T_submap_kf[k], before[k]) for k in before)
    assert bundle.result.cost_after < bundle.result.cost_before
    submap.apply_estimate(*bundle.estimate)
    for k in range(16):
        assert np.array_equal(submap.T_submap_kf[k], before[k]) == (k not in (10, 11, 12))
    t, _ = pose_errors(submap.keyframe_poses([10, 11, 12]), scene.T_true[10:13])
    assert t.max() < 0.01
