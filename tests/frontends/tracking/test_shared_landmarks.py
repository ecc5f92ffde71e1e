"""Landmarks that keyframes have mapped twice become one, and no keyframe sees one twice."""

from __future__ import annotations

import numpy as np

from dualslam.core.types import IntArray
from dualslam.frontends.tracking.registrar import share_landmarks
from dualslam.map.submap import NO_LANDMARK, Submap
from dualslam.testing.graph_scene import K, make_scene

N_POINTS = 4


def mapped_twice() -> tuple[Submap, IntArray]:
    """Return a submap in which keyframes 0 and 1 have mapped what 2 and 3 map again; the last feature of 3 is free."""
    scene, submap = make_scene(4, 100), Submap(0, K, np.zeros(4, np.uint8))
    for k in range(4):
        submap.add_keyframe(scene.keyframe(k), scene.T_true[k])
    feature = np.arange(N_POINTS)
    for first, second in ((0, 1), (2, 3)):
        xyz = np.tile([0.0, 0.0, 2.0], (N_POINTS, 1))
        ids = submap.add_landmarks(xyz, np.zeros((N_POINTS, 4), np.uint8), np.ones(N_POINTS), first)
        submap.add_observations(first, feature, ids)
        submap.add_observations(second, feature, ids)
    submap.remove_observations(submap.find_observations(np.array([3]), feature[-1:], ids[-1:]))
    return submap, np.column_stack((feature, feature))


def test_landmarks_become_one_and_free_features_see_them() -> None:
    submap, pairs = mapped_twice()
    assert share_landmarks(submap, [(0, 2, pairs), (0, 3, pairs)]) == N_POINTS + 1
    np.testing.assert_array_equal(submap.landmark_of[0][:N_POINTS], submap.landmark_of[3][:N_POINTS])
    np.testing.assert_array_equal(submap.n_observations(submap.landmark_of[0][:N_POINTS]), np.full(N_POINTS, 4))
    assert np.count_nonzero(submap.landmarks["alive"]) == N_POINTS


def test_nothing_is_seen_twice_in_a_keyframe() -> None:
    submap, pairs = mapped_twice()
    crossed = np.column_stack((pairs[:, 0], pairs[::-1, 1]))
    share_landmarks(submap, [(0, 2, pairs), (1, 3, crossed)])
    for k in submap.keyframes:
        seen = submap.seen_in(k)
        assert len(np.unique(seen)) == len(seen)
        rows = np.flatnonzero(submap.observations["alive"] & (submap.observations["kf"] == k))
        np.testing.assert_array_equal(
            submap.landmark_of[k][submap.observations["feature"][rows]], submap.observations["landmark"][rows]
        )


def test_features_without_landmarks_stay_without() -> None:
    submap, _ = mapped_twice()
    beyond = np.array([[N_POINTS, N_POINTS]])
    assert share_landmarks(submap, [(0, 2, beyond)]) == 0
    assert submap.landmark_of[0][N_POINTS] == NO_LANDMARK
