"""The back end by itself: what the documentation shows (docs/backend.md), run."""

from __future__ import annotations

from dualslam.backend import ISam2SubmapGraph
from dualslam.config.settings import GraphConfig
from dualslam.testing.graph_scene import guessed_submap, make_scene, pose_errors


def test_a_factor_graph_finds_the_truth_from_a_bad_guess() -> None:
    scene = make_scene(n_keyframes=20, noise_px=1.0, seed=0)
    submap = guessed_submap(scene, pose_noise=0.02)  # keyframes, landmarks, observations; depths are about 1
    before, _ = pose_errors(submap.keyframe_poses(range(20)), scene.T_true)
    estimate = ISam2SubmapGraph(GraphConfig()).update(submap)
    after, turned_rad = pose_errors(estimate.T_submap_kf, scene.T_true[estimate.keyframe_ids])
    assert before.max() > 0.02
    assert after.max() < 0.01
    assert turned_rad.max() < 0.01
