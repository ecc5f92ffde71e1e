"""Which points are too near to be believed unproven."""

from __future__ import annotations

import numpy as np

from dualslam.frontends.tracking.local_map import nearer_than_proven, stands_before


def test_only_what_is_unproven_and_nearer_than_any_proof_is_left_out() -> None:
    depth = np.array([4.0, 5.0, 6.0, 0.3, 3.0, -1.0, 40.0])
    proven = np.array([True, True, True, False, False, False, False])
    assert np.flatnonzero(nearer_than_proven(depth, proven)).tolist() == [3, 5]


def test_proven_points_that_are_near_vouch_for_others_there() -> None:
    depth, proven = np.r_[np.full(90, 5.0), np.full(10, 0.3), 0.25], np.r_[np.full(100, True), False]
    assert not nearer_than_proven(depth, proven).any()


def test_a_single_near_one_does_not() -> None:
    depth, proven = np.r_[np.full(99, 5.0), 0.3, 0.25], np.r_[np.full(100, True), False]
    assert np.flatnonzero(nearer_than_proven(depth, proven)).tolist() == [100]


def test_where_nothing_is_proven_nothing_is_left_out() -> None:
    assert not nearer_than_proven(np.array([0.1, 5.0]), np.zeros(2, bool)).any()


def test_a_few_stand_before_all_others_and_many_do_not() -> None:
    assert np.flatnonzero(stands_before(depth := np.r_[np.full(97, 5.0), 0.3, 2.4, 2.6], depth)).tolist() == [97, 98]
    assert not stands_before(depth := np.r_[np.full(90, 5.0), np.full(10, 0.3)], depth).any()
