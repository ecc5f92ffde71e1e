"""The graph follows its submap: optimum, growth, deaths, gauge."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.backend import submap_graph
from dualslam.backend.local_ba import bundle_adjust
from dualslam.backend.submap_graph import ISam2SubmapGraph
from dualslam.backend.window import NumpyWindowSolver
from dualslam.core.config.settings import GraphConfig
from dualslam.core.errors import SolverError
from dualslam.core.geometry import se3, so3
from dualslam.map.anchors import RelativePose
from dualslam.testing.graph_scene import Feeder, make_scene, pose_errors

OPTIMUM_MU, OPTIMUM_RAD = 5e-3, 5e-3
"""How far iSAM2, which does not relinearise what moves little, may be from the batch optimum: less than the standard
deviation of the last pose, and nowhere more than one standard deviation of the same pose."""


EVERY_FACTOR = {"factors_per_keyframe": 10_000}
"""Nothing is left out: what these tests ask of the solver is then what the observations say."""


def apply(submap, estimate):
    submap.apply_estimate(estimate.keyframe_ids, estimate.T_submap_kf, estimate.landmark_ids, estimate.xyz_mu)


def start(n=30, per_view=120, noise_px=1.0, seed=0, config=None, order=None, first=4, **feeder):
    scene = make_scene(n, per_view, noise_px, seed)
    feeder = Feeder(scene, **feeder)
    order = list(range(n)) if order is None else order
    for k in order[:first]:
        feeder.add(k, exact=True)
    feeder.submap.gauge = (order[0], order[first - 1])
    graph = ISam2SubmapGraph(config or GraphConfig(**EVERY_FACTOR))
    apply(feeder.submap, graph.update(feeder.submap))
    return feeder, graph, order[first:]


def pose(submap, k):
    """Pose a new keyframe by its neighbours, as a front end does before the graph looks at it."""
    newest = list(submap.keyframes)[-3:][::-1]
    posed = NumpyWindowSolver(GraphConfig().robust_k)(submap, newest)
    if posed:
        apply(submap, posed)


def grow(feeder, graph, keyframes, window=True):
    estimates = []
    for k in keyframes:
        feeder.add(k)
        if window:
            pose(feeder.submap, k)
        estimates.append(graph.update(feeder.submap))
        apply(feeder.submap, estimates[-1])
    return estimates


def test_exact_pixels_give_the_exact_map():
    feeder, graph, rest = start(noise_px=0.0)
    grow(feeder, graph, rest)
    e = graph.full_estimate(feeder.submap)
    t, r = pose_errors(e.T_submap_kf, feeder.scene.T_true[e.keyframe_ids])
    assert t.max() < 1e-3
    assert r.max() < 1e-3
    truth = feeder.scene.xyz_true[feeder.point_of_landmark()[e.landmark_ids]]
    assert np.median(np.linalg.norm(e.xyz_mu - truth, axis=1)) < 1e-3


def test_estimate_is_near_the_batch_optimum_and_the_newest_fit():
    feeder, graph, rest = start()
    estimates = grow(feeder, graph, rest)
    assert not any(e.rebuilt for e in estimates)
    chi2 = np.array([e.chi2_newest for e in estimates])
    assert 0.5 < np.median(chi2) < 1.3
    e = graph.full_estimate(feeder.submap)
    apply(feeder.submap, e)
    batch = bundle_adjust(feeder.submap, e.keyframe_ids[2:], e.keyframe_ids[:2], max_iterations=30)
    oracle = ISam2SubmapGraph(GraphConfig(**EVERY_FACTOR), rebuild_iterations=50).rebuild(feeder.submap)
    np.testing.assert_array_equal(oracle.keyframe_ids, e.keyframe_ids)
    t, r = pose_errors(e.T_submap_kf, oracle.T_submap_kf)
    assert t.max() < OPTIMUM_MU
    assert r.max() < OPTIMUM_RAD
    sigma = np.sqrt([np.diag(graph.pose_covariance(int(k))) for k in e.keyframe_ids[1:]])
    assert (r[1:] < np.linalg.norm(sigma[:, :3], axis=1)).all()
    assert (t[1:] < np.linalg.norm(sigma[:, 3:], axis=1)).all()
    # Another solver entry, with the second pose fixed instead of a distance, agrees as well.
    by_id = np.argsort(batch.keyframe_ids)
    t, r = pose_errors(e.T_submap_kf, batch.result.T_submap_kf[by_id])
    assert t.max() < 2 * OPTIMUM_MU


@pytest.mark.parametrize("turn_rad", [0.05, 0.2])
def test_the_baseline_that_fixes_the_scale_is_turned_back(turn_rad):
    """It bears small steps alone, and holds up no others: of 0.2 rad, a solution once took none at all."""
    feeder, graph, rest = start(first=2)
    grow(feeder, graph, rest)
    submap = feeder.submap
    apply(submap, graph.full_estimate(submap))
    askew, (first, second) = submap.copy(), submap.gauge
    centre, T = submap.T_submap_kf[first][:3, 3], submap.T_submap_kf[second].copy()
    baseline = T[:3, 3] - centre
    across = np.cross(baseline, [0.0, 0.0, 1.0])
    T[:3, 3] = centre + so3.exp(turn_rad * across / np.linalg.norm(across)) @ baseline
    askew.T_submap_kf[second] = T
    e = ISam2SubmapGraph(GraphConfig(**EVERY_FACTOR)).rebuild(askew)
    t, _ = pose_errors(e.T_submap_kf, submap.keyframe_poses(e.keyframe_ids))
    assert t.max() < 0.1 * np.linalg.norm(baseline)


def test_window_is_read_each_time_and_all_each_nth_time(monkeypatch):
    monkeypatch.setattr(submap_graph, "READ_WINDOW", 6)
    monkeypatch.setattr(submap_graph, "READ_ALL_EVERY", 5)
    feeder, graph, rest = start()
    sizes = [len(e.keyframe_ids) for e in grow(feeder, graph, rest)]
    assert max(sizes[:4] + sizes[5:9]) < 12 < len(rest)
    assert sizes[9] == 4 + 10
    everything = graph.full_estimate(feeder.submap)
    assert len(everything.keyframe_ids) == 30


def test_outliers_are_reported_and_borne():
    feeder, graph, rest = start(noise_px=0.5)
    rng = np.random.default_rng(5)
    wrong = set()
    for k in rest:
        uv = feeder.scene.features[k].uv_rect_px
        bad = rng.permutation(len(uv))[: len(uv) // 10]
        uv[bad] += rng.choice([-1, 1], (len(bad), 2)) * rng.uniform(12, 20, (len(bad), 2))
        wrong |= {(k, f) for f in bad.tolist()}
        rebuilt = grow(feeder, graph, [k])[0].rebuilt
        assert not rebuilt
    e = graph.full_estimate(feeder.submap)
    t, _ = pose_errors(e.T_submap_kf, feeder.scene.T_true[e.keyframe_ids])
    assert t.max() < 0.05
    obs = feeder.submap.observations
    found = set(zip(obs["kf"][e.outlier_rows].tolist(), obs["feature"][e.outlier_rows].tolist(), strict=True))
    # A landmark enters the graph with its third view: what only two keyframes saw is not judged.
    judged = np.isin(obs["landmark"], e.landmark_ids)
    present = wrong & set(zip(obs["kf"][judged].tolist(), obs["feature"][judged].tolist(), strict=True))
    assert len(found & present) > 0.9 * len(present)
    assert len(found - present) < 0.08 * len(obs)


@pytest.mark.parametrize(("noise", "gauged"), [(0.5, 0.6), (0.8, 0.8), (2.0, 2.0)])
def test_the_outliers_gate_follows_the_noise_that_residuals_have(noise, gauged):
    """In pixels better and worse than their sigmas, what is five standard deviations off is out, and nothing else."""
    feeder, graph, rest = start(noise_px=noise)
    rng = np.random.default_rng(3)
    wrong = set()
    for k in rest:
        f = feeder.scene.features[k]
        bad = rng.permutation(len(f.uv_px))[: len(f.uv_px) // 20]
        f.uv_rect_px[bad, 0] += rng.choice([-5.0, 5.0], len(bad)) * gauged * f.sigma_px[bad]
        wrong |= {(k, i) for i in bad.tolist()}
    assert grow(feeder, graph, rest)[-1].noise2 == pytest.approx(gauged**2, rel=0.15)
    e, obs = graph.full_estimate(feeder.submap), feeder.submap.observations
    n_views = np.bincount(obs["landmark"], minlength=len(feeder.submap.landmarks))
    judged = np.isin(obs["landmark"], e.landmark_ids) & (n_views[obs["landmark"]] >= 6)
    is_wrong = np.array([pair in wrong for pair in zip(obs["kf"].tolist(), obs["feature"].tolist(), strict=True)])
    is_out = np.isin(np.arange(len(obs)), e.outlier_rows)
    assert is_out[judged & is_wrong].mean() > 0.88
    assert is_out[judged & ~is_wrong].mean() < 0.03


def test_observations_beyond_all_use_are_refused_and_reported():
    feeder, graph, rest = start()
    uv = feeder.scene.features[rest[0]].uv_rect_px
    uv[:5] = 5.0
    e = grow(feeder, graph, rest[:1])[0]
    obs = feeder.submap.observations
    mine = np.flatnonzero((obs["kf"] == rest[0]) & (obs["feature"] < 5))
    assert np.isin(mine, e.outlier_rows).all()
    assert (graph._factor_index.rows["factor"][mine] < 0).all()


def test_dead_rows_leave_and_so_do_landmarks_left_with_one():
    feeder, graph, rest = start()
    grow(feeder, graph, rest[:10])
    submap = feeder.submap
    rng = np.random.default_rng(3)
    landmark = int(np.argmax(submap.n_observations(np.arange(len(submap.landmarks)))))
    rows = submap.rows_of_landmarks(np.array([landmark]))
    submap.remove_observations(rows[1:])
    gone = rng.choice(np.flatnonzero(submap.landmarks["alive"]), 40, replace=False)
    gone = gone[gone != landmark]
    submap.remove_landmarks(gone)
    e = grow(feeder, graph, rest[10:11])[0]
    assert not e.rebuilt
    full = graph.full_estimate(submap)
    assert landmark not in full.landmark_ids
    assert not np.isin(gone, full.landmark_ids).any()
    assert (graph._factor_index.rows["factor"][rows] < 0).all()
    later = grow(feeder, graph, rest[11:16])
    assert not any(x.rebuilt for x in later)


def test_merged_landmarks():
    feeder, graph, rest = start()
    grow(feeder, graph, rest[:6])
    submap, k = feeder.submap, 3
    # The same points, found again as other landmarks by the next keyframes, then recognised.
    twins = submap.landmark_of[k][:20].copy()
    twins = twins[twins >= 0]
    points = feeder.point_of_landmark()[twins]
    feeder.landmark_of_point[points] = -1
    for p in points.tolist():
        feeder.first_view.pop(p, None)
    grow(feeder, graph, rest[6:10])
    found_again = feeder.landmark_of_point[points]
    keep, drop = twins[found_again >= 0], found_again[found_again >= 0]
    assert len(drop) > 3
    submap.merge_landmarks(keep, drop)
    feeder.landmark_of_point[points[found_again >= 0]] = keep
    estimates = grow(feeder, graph, rest[10:13])
    assert not any(e.rebuilt for e in estimates)
    full = graph.full_estimate(submap)
    assert not np.isin(drop, full.landmark_ids).any()


@pytest.mark.parametrize("which", [0, 1])
def test_culled_gauge_keyframe_moves_the_gauge_without_a_jump(which):
    feeder, graph, rest = start()
    grow(feeder, graph, rest[:8])
    submap = feeder.submap
    apply(submap, graph.full_estimate(submap))
    before = {k: T.copy() for k, T in submap.T_submap_kf.items()}
    culled = submap.gauge[which]
    submap.remove_keyframe(culled, anchor_id=culled + 1 if which == 0 else culled - 1)
    e = graph.update(submap)
    assert not e.rebuilt
    assert culled not in e.keyframe_ids
    kept = e.keyframe_ids
    t, r = pose_errors(e.T_submap_kf, np.array([before[k] for k in kept.tolist()]))
    assert t.max() < 0.01
    assert r.max() < 0.01
    apply(submap, e)
    assert not any(x.rebuilt for x in grow(feeder, graph, rest[8:12]))


def test_growth_at_the_early_end():
    order = list(range(12, 24)) + list(range(11, -1, -1))
    feeder, graph, rest = start(24, order=order)
    estimates = grow(feeder, graph, rest)
    assert not any(e.rebuilt for e in estimates)
    e = graph.full_estimate(feeder.submap)
    assert e.keyframe_ids.tolist() == list(range(24))
    t, _ = pose_errors(e.T_submap_kf, feeder.scene.T_true)
    assert t.max() < 0.03


def test_submap_in_another_gauge_is_noticed():
    feeder, graph, rest = start()
    grow(feeder, graph, rest[:3])
    apply(feeder.submap, graph.full_estimate(feeder.submap))
    T = np.eye(4)
    T[:3, 3] = [1.0, 2.0, 3.0]
    feeder.submap.transform(2.0, T)
    e = graph.update(feeder.submap)
    assert e.rebuilt
    np.testing.assert_allclose(e.T_submap_kf[0], feeder.submap.T_submap_kf[0], atol=1e-4)


def test_same_input_same_estimate_bit_for_bit():
    def run():
        feeder, graph, rest = start(12)
        grow(feeder, graph, rest)
        return graph.full_estimate(feeder.submap)

    a, b = run(), run()
    assert np.array_equal(a.T_submap_kf, b.T_submap_kf)
    assert np.array_equal(a.xyz_mu, b.xyz_mu)


def test_covariances_against_monte_carlo():
    runs, k = [], 9
    for seed in range(40):
        # The same scene and gauge, other pixels.
        scene = make_scene(10, 80, 0.0, seed=0)
        rng = np.random.default_rng(100 + seed)
        for f in scene.features:
            f.uv_rect_px[:] += f.sigma_px[:, None] * rng.normal(size=f.uv_rect_px.shape)
        feeder = Feeder(scene)
        for i in range(10):
            feeder.add(i, exact=True)
        feeder.submap.gauge = (0, 3)
        graph = ISam2SubmapGraph(GraphConfig(robust_k=100.0, **EVERY_FACTOR), rebuild_iterations=20)
        e = graph.update(feeder.submap)
        off = np.linalg.inv(scene.T_true[k]) @ e.T_submap_kf[k]
        runs.append(off[:3, 3])
        if seed == 0:
            covariance = graph.pose_covariance(k)
            points = graph.point_covariances(np.array([e.landmark_ids[0], 10**6, -1]))
    assert covariance.shape == (6, 6)
    ratio = np.array(runs).std(0) / np.sqrt(np.diag(covariance)[3:])
    assert (ratio > 0.6).all()
    assert (ratio < 1.6).all()
    assert (np.linalg.eigvalsh(points[0]) > 0).all()
    assert np.isnan(points[1:]).all()


def test_what_is_not_in_the_graph_has_no_covariance():
    graph = ISam2SubmapGraph(GraphConfig())
    with pytest.raises(SolverError, match="keyframe 3"):
        graph.pose_covariance(3)
    assert np.isnan(graph.point_covariances(np.array([1, 2]))).all()


def relative_to(ref, T_submap_ref, T_submap_kf, covariance):
    return RelativePose(ref, se3.inverse(T_submap_ref) @ T_submap_kf, covariance)


def test_a_relative_pose_counts_by_its_covariance():
    """Two Gaussians of the same pose: informations add, and the estimate moves by their ratio."""
    gaussian = GraphConfig(robust_k=100.0, **EVERY_FACTOR)
    feeder, graph, rest = start(n=8, config=gaussian)
    grow(feeder, graph, rest)
    submap, k = feeder.submap, rest[-1]
    first = submap.gauge[0]  # which does not move
    alone, P = graph.full_estimate(submap), graph.pose_covariance(k)
    T_alone = alone.T_submap_kf[list(alone.keyframe_ids).index(k)]
    xi = 3.0 * np.sqrt(np.diag(P))  # elsewhere says that it is three standard deviations off
    T_known = T_alone @ se3.exp(xi)
    submap.relative_poses[k] = relative_to(first, submap.T_submap_kf[first], T_known, P)  # as sure as the landmarks
    tied = ISam2SubmapGraph(gaussian)
    both = tied.rebuild(submap)
    moved = se3.log(se3.inverse(T_alone) @ both.T_submap_kf[list(both.keyframe_ids).index(k)])
    np.testing.assert_allclose(moved, xi / 2, atol=0.15 * np.abs(xi).max())
    np.testing.assert_allclose(np.diag(tied.pose_covariance(k)), np.diag(P) / 2, rtol=0.1)


def wrongly_tied(n=8):
    """A map of exact pixels whose newest keyframe is said, most surely, to stand elsewhere."""
    feeder, graph, rest = start(n=n, noise_px=0.0)
    k, T = rest[-1], feeder.scene.T_true
    wrong = T[k] @ se3.exp(np.array([0.0, 0.0, 0.0, 0.01, 0.0, 0.0]))
    feeder.submap.relative_poses[k] = relative_to(rest[0], T[rest[0]], wrong, 1e-8 * np.eye(6))
    grow(feeder, graph, rest)
    return feeder, graph, k


def worst(feeder, estimate):
    return pose_errors(estimate.T_submap_kf, feeder.scene.T_true[estimate.keyframe_ids])[0].max()


def test_a_relative_pose_leaves_with_its_keyframe():
    """A keyframe that was taken out again may come back, and is then known by its landmarks alone."""
    feeder, graph, k = wrongly_tied()
    submap = feeder.submap
    assert worst(feeder, graph.full_estimate(submap)) > 5e-3
    obs = submap.observations
    here = (obs["kf"] == k) & obs["alive"]
    feature, landmark = obs["feature"][here].copy(), obs["landmark"][here].copy()
    keyframe = submap.keyframes[k]
    submap.remove_keyframe(k, k - 1)
    graph.update(submap)
    submap.add_keyframe(keyframe, feeder.scene.T_true[k])
    submap.add_observations(k, feature, landmark)
    assert worst(feeder, graph.update(submap)) < 2e-3


def test_the_graph_follows_what_the_submap_knows_of_a_pose():
    feeder, graph, k = wrongly_tied()
    T = feeder.scene.T_true
    feeder.submap.relative_poses[k] = relative_to(k - 2, T[k - 2], T[k], 1e-8 * np.eye(6))
    assert worst(feeder, graph.update(feeder.submap)) < 2e-3
    assert worst(feeder, graph.rebuild(feeder.submap)) < 2e-3


def test_a_relative_pose_outlasts_a_change_of_gauge():
    feeder, graph, _ = wrongly_tied()
    off = worst(feeder, graph.full_estimate(feeder.submap))
    feeder.submap.transform(2.0, np.eye(4))
    e = graph.update(feeder.submap)
    true = feeder.scene.T_true[e.keyframe_ids].copy()
    true[:, :3, 3] *= 2.0
    assert abs(pose_errors(e.T_submap_kf, true)[0].max() / off - 2.0) < 0.2


@pytest.fixture
def spare(monkeypatch):
    """As few factors as in a map of which most keyframes see the same."""
    monkeypatch.setattr("dualslam.backend.factor_index.BUDGET", 1)


@pytest.mark.usefixtures("spare")
def test_a_part_of_the_factors_poses_nearly_as_all_do_and_the_others_follow():
    feeder, graph, rest = start(n=40, per_view=250, config=GraphConfig(factors_per_keyframe=60))
    estimates = grow(feeder, graph, rest)
    assert not any(e.rebuilt for e in estimates)
    submap, rows = feeder.submap, graph.factor_rows
    admitted = np.count_nonzero(graph._factor_index.rows["admitted"])
    assert len(rows) < 0.8 * admitted
    per_keyframe = np.bincount(submap.observations["kf"][rows], minlength=40)
    assert (per_keyframe > 50).all()
    everything = ISam2SubmapGraph(GraphConfig(**EVERY_FACTOR)).rebuild(submap.copy())
    e = graph.full_estimate(submap)
    t_part, _ = pose_errors(e.T_submap_kf, feeder.scene.T_true[e.keyframe_ids])
    t_all, _ = pose_errors(everything.T_submap_kf, feeder.scene.T_true[everything.keyframe_ids])
    assert t_part.max() < 2 * t_all.max() + 0.01
    # Points beside the graph are where their views have them, as sure as those in it.
    variables = np.unique(submap.observations["landmark"][rows])
    beside = ~np.isin(e.landmark_ids, variables)
    assert np.count_nonzero(beside) > 100
    truth = feeder.scene.xyz_true[feeder.point_of_landmark()[e.landmark_ids]]
    off = np.linalg.norm(e.xyz_mu - truth, axis=1)
    assert np.median(off[beside]) < 2 * np.median(off[~beside]) + 0.005


@pytest.mark.usefixtures("spare")
def test_the_choice_is_made_anew_where_a_map_is_past_its_first_keyframes():
    feeder, graph, rest = start(n=26, per_view=250, config=GraphConfig())
    grow(feeder, graph, rest[:16])
    rows = graph._factor_index.rows
    assert (rows["factor"] >= 0)[rows["admitted"]].mean() > 0.98
    (e,) = grow(feeder, graph, rest[16:17])
    assert not e.rebuilt
    assert (rows["factor"] >= 0)[rows["admitted"]].mean() < 0.95
    assert not any(x.rebuilt for x in grow(feeder, graph, rest[17:]))


def test_keyframes_have_more_factors_where_few_see_the_same():
    """This corridor is a road: each stretch is seen from a handful of keyframes."""
    feeder, graph, rest = start(n=30, per_view=250, config=GraphConfig(factors_per_keyframe=40))
    grow(feeder, graph, rest)
    per_keyframe = np.bincount(feeder.submap.observations["kf"][graph.factor_rows], minlength=30)
    assert np.median(per_keyframe) >= 2.5 * 40
