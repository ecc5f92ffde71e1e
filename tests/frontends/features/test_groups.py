"""Helpers that choose among candidate pairs, against plain loops."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.core.arrays import rank_in_runs
from dualslam.frontends.features.groups import (
    ROWS_AT_ONCE,
    best_per_group,
    consistent_rotation,
    mutual_best,
    nearest,
    nearest_by_parts,
)


def test_best_per_group_agrees_with_a_loop() -> None:
    rng = np.random.default_rng(0)
    for n in (0, 1, 200):
        group, cost = rng.integers(0, 30, n), rng.integers(0, 6, n).astype(float)
        cost[cost == 5] = np.inf
        expected = []
        for g in range(30):
            rows = [row for row in range(n) if group[row] == g and np.isfinite(cost[row])]
            if rows:
                expected.append(min(rows, key=lambda row: (cost[row], row)))
        assert best_per_group(group, cost, 30).tolist() == sorted(expected)


def test_rank_in_runs() -> None:
    assert rank_in_runs(np.array([4, 4, 4, 1, 7, 7])).tolist() == [0, 1, 2, 0, 0, 1]
    assert rank_in_runs(np.empty(0, np.int64)).tolist() == []


def test_mutual_best_agrees_with_a_loop_and_leaves_its_input() -> None:
    rng = np.random.default_rng(1)
    for dtype in (np.uint16, np.float64):
        distances = rng.permutation(40 * 50).reshape(40, 50).astype(dtype)
        copy = distances.copy()
        matches = mutual_best(distances, 0.7, 300.0)
        expected = []
        for i in range(40):
            j = int(copy[i].argmin())
            second = np.sort(copy[i])[1]
            if copy[:, j].argmin() == i and copy[i, j] <= 300 and copy[i, j] <= 0.7 * second:
                expected.append([i, j])
        assert matches.index.tolist() == expected
        assert 0 < len(expected) < 40
        np.testing.assert_array_equal(distances, copy)


@pytest.mark.parametrize("n_rows", [1, ROWS_AT_ONCE, 2 * ROWS_AT_ONCE + 1])
def test_nearest_part_by_part_is_that_of_the_whole(n_rows: int) -> None:
    distances = np.random.default_rng(4).integers(0, 40, (n_rows, 30)).astype(np.int32)  # with equals
    whole, parts = nearest(distances), nearest_by_parts(n_rows, lambda rows: distances[rows])
    for name in ("column", "distance", "runner_up"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))
    np.testing.assert_array_equal(np.stack([whole.distance, whole.runner_up], 1), np.sort(distances, axis=1)[:, :2])


def test_mutual_best_of_little() -> None:
    assert len(mutual_best(np.empty((0, 3), np.uint16), 0.8, 50)) == 0
    assert len(mutual_best(np.empty((3, 0), np.uint16), 0.8, 50)) == 0
    assert mutual_best(np.array([[9], [3]], np.uint16), 0.8, 50).index.tolist() == [[1, 0]]


def test_consistent_rotation_keeps_the_majority_wherever_it_lies() -> None:
    rng = np.random.default_rng(2)
    for centre in np.linspace(-7, 7, 57):
        turn = np.concatenate([centre + rng.normal(0, 0.1, 40), centre + rng.uniform(0.9, 2 * np.pi - 0.9, 20)])
        kept = consistent_rotation(turn)
        assert kept[:40].all()
        assert not kept[40:].any()


def test_consistent_rotation_of_equal_or_few_turns() -> None:
    for turn in (0.0, -1e-18, np.pi, -np.pi, 2 * np.pi / 30, 2 * np.pi):
        assert consistent_rotation(np.full(20, turn)).all()
    assert consistent_rotation(np.array([0.0, 1.0, 2.0, 3.0])).all()
