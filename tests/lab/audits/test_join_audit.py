"""Joins across a gap, right and wrong on purpose."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.core.geometry import so3
from dualslam.lab.audits.join_audit import JoinOutcome, audit_join

FIRST, AFTER = 60, 90
INDEX = np.array([*range(FIRST), *range(AFTER, 160)])


def true_poses() -> np.ndarray:
    """A camera that goes sideways at 0.1 m a frame, swaying a little."""
    T = np.tile(np.eye(4), (160, 1, 1))
    T[:, 0, 3] = 0.1 * np.arange(160)
    T[:, 1, 3] = 0.05 * np.sin(np.arange(160) / 7)
    return T


def estimate(offset_m: float = 0.0, scale: float = 1.0, turn_deg: float = 0.0) -> np.ndarray:
    """The truth in another unit and frame, the part after the gap moved, scaled and turned about its start."""
    T = true_poses()
    part, origin = T[AFTER:], T[AFTER, :3, 3].copy()
    R = so3.exp(np.radians([0.0, turn_deg, 0.0]))
    part[:, :3, 3] = origin + scale * (part[:, :3, 3] - origin) @ R.T + [offset_m, 0, 0]
    part[:, :3, :3] = R @ part[:, :3, :3]
    R_world = so3.exp(np.array([0.3, -0.2, 0.9]))
    T[:, :3, 3] = 0.4 * T[:, :3, 3] @ R_world.T + 5.0
    T[:, :3, :3] = R_world @ T[:, :3, :3]
    return T[INDEX]


@pytest.mark.parametrize(
    ("change", "outcome"),
    [
        ({}, JoinOutcome.RIGHT),
        ({"offset_m": 0.3}, JoinOutcome.RIGHT),
        ({"offset_m": 1.0}, JoinOutcome.WRONG),
        ({"scale": 1.05}, JoinOutcome.RIGHT),
        ({"scale": 0.8}, JoinOutcome.WRONG),
        ({"turn_deg": 8.0}, JoinOutcome.WRONG),
    ],
)
def test_the_part_after_is_where_the_truth_puts_it_or_not(change: dict[str, float], outcome: JoinOutcome) -> None:
    assert audit_join(INDEX, estimate(**change), true_poses()[INDEX], FIRST, AFTER).outcome is outcome


def test_the_errors_are_measured() -> None:
    join = audit_join(INDEX, estimate(offset_m=0.3), true_poses()[INDEX], FIRST, AFTER)
    assert join.offset_m == pytest.approx(0.3, abs=1e-6)
    assert join.scale_ratio == pytest.approx(1.0, abs=1e-6)
    assert join.turn_deg == pytest.approx(0.0, abs=1e-4)


def test_a_tolerance_that_is_given_replaces_the_share_of_the_path() -> None:
    assert audit_join(INDEX, estimate(0.3), true_poses()[INDEX], FIRST, AFTER, 0.2).outcome is JoinOutcome.WRONG


def test_a_part_with_too_few_frames_is_not_joined() -> None:
    few = (INDEX < FIRST) | (INDEX >= 151)
    join = audit_join(INDEX[few], estimate()[few], true_poses()[INDEX][few], FIRST, AFTER)
    assert join.outcome is JoinOutcome.NOT_JOINED
    assert (join.n_before, join.n_after) == (60, 9)
