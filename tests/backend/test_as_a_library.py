"""The back end by itself: what the documentation shows (docs/backend.md), run."""

from __future__ import annotations

import pytest

import dualslam
from dualslam.backend.submap_graph import ISam2SubmapGraph
from dualslam.core.config.settings import GraphConfig
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


def test_a_graph_of_ones_own_serves_a_whole_run() -> None:
    made: list[ISam2SubmapGraph] = []

    def new_graph() -> ISam2SubmapGraph:
        made.append(ISam2SubmapGraph(GraphConfig()))
        return made[-1]

    sequence = dualslam.open_source("synthetic:street,frames=30,seed=3,width=320,height=240")
    config = dualslam.load_config(overrides=["frontend.n_features=500"])
    system = dualslam.build_system(config, sequence.camera, new_graph=new_graph)
    for frame in sequence:
        system.step(frame)
    assert system.live is not None
    assert system.live.graph in made
    graph = made[made.index(system.live.graph)]
    assert len(graph.factor_rows) > 0
    assert len(graph.full_estimate(system.live.submap).keyframe_ids) == len(system.live.submap.keyframes)
    beside = dualslam.load_config(overrides=["recovery.workers=1"])
    with pytest.raises(dualslam.InputError, match=r"recovery\.workers to 0"):
        dualslam.build_system(beside, sequence.camera, new_graph=new_graph)
