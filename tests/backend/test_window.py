"""A new keyframe is posed by a small bundle: as the whole graph would, quickly, and the gauge stays."""

from __future__ import annotations

import numpy as np

from dualslam.backend.submap_graph import ISam2SubmapGraph
from dualslam.backend.window import NumpyWindowSolver, _evaluate, _window, adjust_window
from dualslam.core.config.settings import GraphConfig
from dualslam.core.geometry import se3
from dualslam.core.types import Failure
from dualslam.testing.graph_scene import pose_errors
from tests.backend.test_submap_graph import grow, start


def solver() -> NumpyWindowSolver:
    return NumpyWindowSolver(GraphConfig().robust_k)


def newest(submap, n=3):
    return list(submap.keyframes)[-n:][::-1]


def one_more(noise_px=1.0, off=(0.004, -0.003, 0.002, 0.02, 0.01, -0.02), n=14, **kwargs):
    """A solved map and one more keyframe, which tracking has posed badly."""
    feeder, graph, rest = start(n=n, noise_px=noise_px, **kwargs)
    grow(feeder, graph, rest[:-1])
    feeder.add(rest[-1], exact=True)
    submap = feeder.submap
    submap.T_submap_kf[rest[-1]] = submap.T_submap_kf[rest[-1]] @ se3.exp(np.array(off))
    return feeder, graph, rest[-1]


def test_it_finds_the_pose_of_exact_pixels() -> None:
    feeder, _, k = one_more(noise_px=0.0)
    estimate = solver()(feeder.submap, newest(feeder.submap))
    assert estimate
    t, r = pose_errors(estimate.T_submap_kf, feeder.scene.T_true[estimate.keyframe_ids])
    assert estimate.keyframe_ids[0] == k
    assert t.max() < 3e-3
    assert r.max() < 1e-3


def test_it_poses_as_the_whole_graph_does() -> None:
    feeder, _, k = one_more()
    estimate = solver()(feeder.submap, newest(feeder.submap))
    whole = ISam2SubmapGraph(GraphConfig(factors_per_keyframe=10_000))
    oracle = whole.rebuild(feeder.submap)
    T = oracle.T_submap_kf[list(oracle.keyframe_ids).index(k)]
    off = np.abs(se3.log(se3.inverse(T) @ estimate.T_submap_kf[0]))
    assert (off < 2 * np.sqrt(np.diag(whole.pose_covariance(k)))).all()
    assert 0.5 < estimate.chi2_newest < 1.5


def test_wrong_matches_are_borne_and_named() -> None:
    feeder, _, k = one_more(noise_px=0.5)
    submap = feeder.submap
    obs = submap.observations
    mine = np.flatnonzero((obs["kf"] == k) & obs["alive"])
    # Of landmarks that four keyframes see: two views and a wrong third are anyone's guess.
    known = mine[submap.n_observations(obs["landmark"][mine]) >= 4]
    wrong = known[:: max(len(known) // 8, 1)]
    submap.keyframes[k].features.uv_rect_px[obs["feature"][wrong]] += [14.0, -11.0]
    estimate = solver()(submap, newest(submap))
    assert np.isin(wrong, estimate.outlier_rows).mean() > 0.9
    assert len(np.setdiff1d(estimate.outlier_rows, wrong)) < 0.1 * len(mine)
    assert (obs["kf"][estimate.outlier_rows] == k).all()
    assert pose_errors(estimate.T_submap_kf[:1], feeder.scene.T_true[[k]])[0].max() < 0.02


def test_the_submap_is_not_changed_and_the_gauge_stays() -> None:
    feeder, _, k = one_more()
    submap = feeder.submap
    submap.gauge = (submap.gauge[0], list(submap.keyframes)[-2])
    before = submap.copy()
    estimate = solver()(submap, newest(submap))
    assert estimate.keyframe_ids.tolist() == [k, list(submap.keyframes)[-3]]
    np.testing.assert_array_equal(submap.T_submap_kf[k], before.T_submap_kf[k])
    np.testing.assert_array_equal(submap.landmarks["xyz_mu"], before.landmarks["xyz_mu"])
    submap.gauge = (k, submap.gauge[0])
    assert isinstance(solver()(submap, newest(submap)), Failure)


def test_without_others_that_hold_it_there_is_no_window() -> None:
    feeder, _, _ = one_more(n=6)
    submap = feeder.submap
    for other in list(submap.keyframes)[:-1]:
        rows = np.flatnonzero((submap.observations["kf"] == other) & submap.observations["alive"])
        submap.remove_observations(rows)
    assert isinstance(solver()(submap, newest(submap)), Failure)


def test_points_and_poses_against_a_dense_least_squares_step() -> None:
    """The Schur complement is the same as the whole normal equations: the gradient vanishes at the optimum found."""
    feeder, _, _ = one_more(noise_px=0.5)
    submap = feeder.submap
    free = newest(submap)
    _, _, window = _window(submap, free, submap.landmarks_of_keyframes(free[:1]))
    best = adjust_window(window, 1.345, iterations=60)
    for f in range(len(free)):
        for axis in range(6):
            costs = []
            for h in (1e-5, -1e-5):
                T = best.T.copy()
                T[f] = T[f] @ se3.exp(h * np.eye(6)[axis])
                costs.append(_evaluate(window, T, best.xyz, 1.345).cost)
            curvature = (sum(costs) - 2 * best.cost) / 1e-10
            assert abs(costs[0] - costs[1]) / 2e-5 < 2e-2 * np.sqrt(curvature)
