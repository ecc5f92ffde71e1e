"""What would kill a solver does not reach the caller, and costs no keyframe."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from dualslam.backend import submap_graph as module
from dualslam.backend.solver import IncrementalSolver, SolverFailure
from dualslam.backend.submap_graph import ISam2SubmapGraph
from dualslam.core.config.settings import GraphConfig
from dualslam.core.errors import SolverError
from dualslam.map.submap import Submap
from dualslam.testing.graph_scene import K, pose_errors
from tests.backend.test_submap_graph import apply, grow, start


def observe(submap, k, landmark):
    """Let keyframe `k` see a landmark where it truly is, with a feature that is free or has to give up its own."""
    free = np.flatnonzero(submap.landmark_of[k] < 0)[:1]
    if len(free) == 0:
        free = np.array([landmark % 50])
        obs = submap.observations
        submap.remove_observations(np.flatnonzero((obs["kf"] == k) & (obs["feature"] == free) & obs["alive"]))
    T, xyz = submap.T_submap_kf[k], submap.landmarks["xyz_mu"][landmark]
    cam = (xyz - T[:3, 3]) @ T[:3, :3]
    submap.keyframes[k].features.uv_rect_px[free] = 700.0 * cam[:2] / cam[2] + K[:2, 2]
    submap.add_observations(k, free, np.array([landmark]))


def add_landmark(submap, xyz, views):
    """Put a landmark in, seen by the keyframes `views`."""
    j = int(submap.add_landmarks(np.array([xyz], float), np.zeros((1, 4), np.uint8), np.ones(1), views[0])[0])
    for k in views:
        observe(submap, k, j)
    return j


def test_degenerate_landmarks_stay_out_until_they_can_be_borne():
    feeder, graph, rest = start()
    grow(feeder, graph, rest[:4])
    submap = feeder.submap
    T = submap.T_submap_kf[5]
    one_view = add_landmark(submap, T[:3, 3] + T[:3, :3] @ [0.1, 0.0, 1.0], [5])
    far = add_landmark(submap, T[:3, 3] + T[:3, :3] @ [10.0, 5.0, 5000.0], [5, 6])
    behind = add_landmark(submap, T[:3, 3] + T[:3, :3] @ [0.1, 0.0, -1.0], [5, 6])
    e = graph.update(submap)
    assert not e.rebuilt
    full = graph.full_estimate(submap)
    assert not np.isin([one_view, far, behind], full.landmark_ids).any()
    # Further views, from the side, bring the first one in: the third, once the graph is past its first keyframes.
    observe(submap, 2, one_view)
    assert not graph.update(submap).rebuilt
    assert one_view not in graph.full_estimate(submap).landmark_ids
    observe(submap, 3, one_view)
    assert not graph.update(submap).rebuilt
    assert one_view in graph.full_estimate(submap).landmark_ids


def test_non_finite_points_stay_out():
    feeder, graph, _ = start()
    submap = feeder.submap
    bad = add_landmark(submap, submap.T_submap_kf[1][:3, 3] + [0.0, 0.0, 1.0], [1, 2])
    submap.landmarks["xyz_mu"][bad] = np.nan
    assert not graph.update(submap).rebuilt
    assert bad not in graph.full_estimate(submap).landmark_ids


@pytest.mark.parametrize("gauge", [(-1, -1), (0, 0), (900, 901)])
def test_missing_gauge_is_made_good(gauge):
    feeder, _, rest = start()
    feeder.submap.gauge = gauge
    graph = ISam2SubmapGraph(GraphConfig())
    apply(feeder.submap, graph.update(feeder.submap))
    estimates = grow(feeder, graph, rest[:5])
    assert not any(e.rebuilt for e in estimates)


def test_a_pose_that_is_not_finite_is_named():
    feeder, _, _ = start(first=4)
    feeder.submap.T_submap_kf[2] = np.full((4, 4), np.nan)
    graph = ISam2SubmapGraph(GraphConfig())
    with pytest.raises(SolverError, match=r"submap 0: the pose of keyframe 2 is not finite; give it a guess$"):
        graph.update(feeder.submap)
    feeder.submap.T_submap_kf[2] = feeder.submap.T_submap_kf[1].copy()
    assert np.isfinite(graph.update(feeder.submap).T_submap_kf).all()


def test_one_keyframe_and_none():
    feeder, _, _ = start(first=1)
    graph = ISam2SubmapGraph(GraphConfig())
    e = graph.update(feeder.submap)
    assert e.keyframe_ids.tolist() == [0]
    assert len(e.landmark_ids) == 0
    grow(feeder, graph, [1, 2, 3, 4])
    with pytest.raises(SolverError, match="no keyframes"):
        ISam2SubmapGraph(GraphConfig()).update(Submap(1, K, np.zeros(4, np.uint8)))


def test_an_untied_keyframe_is_held_then_let_go():
    feeder, graph, rest = start()
    submap, k = feeder.submap, rest[0]
    feeder.add(k)
    rows = np.flatnonzero(submap.observations["kf"] == k)
    submap.remove_observations(rows[2:])
    e = graph.update(submap)
    assert not e.rebuilt
    assert k in e.keyframe_ids
    assert k in graph._ties.holds
    apply(submap, e)
    features, landmarks = submap.observations["feature"][rows[2:]], submap.observations["landmark"][rows[2:]]
    submap.add_observations(k, features, landmarks)
    assert not graph.update(submap).rebuilt
    assert k not in graph._ties.holds


def test_an_island_of_keyframes_is_held():
    feeder, graph, rest = start(24)
    grow(feeder, graph, rest[:8])
    for k in range(20, 24):
        feeder.add(k, exact=True)
    rows = np.flatnonzero(feeder.submap.observations["kf"] >= 20)
    shared = np.isin(
        feeder.submap.observations["landmark"][rows],
        feeder.submap.observations["landmark"][feeder.submap.observations["kf"] < 20],
    )
    feeder.submap.remove_observations(rows[shared])
    e = graph.rebuild(feeder.submap)
    assert set(range(20, 24)) <= set(e.keyframe_ids.tolist())
    t, _ = pose_errors(e.T_submap_kf[-4:], feeder.submap.keyframe_poses(list(range(20, 24))))
    assert t.max() < 0.05


class Saboteur:
    """Replaces the solver's update by one that fails on a few calls."""

    def __init__(self, monkeypatch, failures):
        self.failures = list(failures)
        original = IncrementalSolver.update

        def update(solver, *args, **options):
            if self.failures:
                failure = self.failures.pop(0)
                if failure is not None:
                    raise failure
            return original(solver, *args, **options)

        monkeypatch.setattr(IncrementalSolver, "update", update)


def test_exception_rebuilds_without_the_named_landmark_and_with_every_keyframe(monkeypatch, caplog):
    feeder, graph, rest = start()
    grow(feeder, graph, rest[:6])
    named = int(graph.full_estimate(feeder.submap).landmark_ids[-1])
    Saboteur(monkeypatch, [SolverFailure("Indeterminate linear system", named)])
    feeder.add(rest[6])
    with caplog.at_level(logging.INFO):
        e = graph.update(feeder.submap)
    assert e.rebuilt
    assert "rebuilding" in caplog.text
    assert e.keyframe_ids.tolist() == sorted(feeder.submap.keyframes)
    assert named not in e.landmark_ids
    apply(feeder.submap, e)
    assert not any(x.rebuilt for x in grow(feeder, graph, rest[7:10]))


def test_a_real_gtsam_exception_is_survived(monkeypatch):
    """A point behind its cameras, let in by force, makes GTSAM throw; the graph comes back without it."""
    feeder, graph, rest = start()
    grow(feeder, graph, rest[:6])
    submap = feeder.submap
    T = submap.T_submap_kf[5]
    bad = add_landmark(submap, T[:3, 3] + T[:3, :3] @ [0.1, 0.0, -1.0], [3, 4, 5])
    real = module.FactorIndex._judge
    calls = []

    def gullible(self, submap, poses, xyz_mu, row, *args):
        fits, certain = real(self, submap, poses, xyz_mu, row, *args)
        calls.append(1)
        if len(calls) <= 3:  # the update, and both plans of the first rebuild
            certain[bad] = bad not in self.banned
            fits = fits | (submap.observations["landmark"][row] == bad)
        return fits, certain

    monkeypatch.setattr(module.FactorIndex, "_judge", gullible)
    e = graph.update(submap)
    assert e.rebuilt
    assert bad not in e.landmark_ids
    assert e.keyframe_ids.tolist() == sorted(submap.keyframes)


def test_a_failure_that_names_nothing_or_a_pose(monkeypatch):
    feeder, graph, rest = start()
    Saboteur(
        monkeypatch, [SolverFailure("the solver is dead (no cliques)"), SolverFailure("x", module.convert.pose_key(2))]
    )
    feeder.add(rest[0])
    e = graph.update(feeder.submap)
    assert e.rebuilt
    assert 2 in graph._ties.holds


def test_what_cannot_be_rebuilt_is_said_in_our_words(monkeypatch):
    feeder, graph, rest = start()
    Saboteur(monkeypatch, [SolverFailure("Indeterminate linear system")] * 50)
    feeder.add(rest[0])
    with pytest.raises(SolverError, match="submap 0 could not be made in 8 attempts: Indeterminate"):
        graph.update(feeder.submap)
    monkeypatch.undo()
    assert len(graph.update(feeder.submap).keyframe_ids) == 5
