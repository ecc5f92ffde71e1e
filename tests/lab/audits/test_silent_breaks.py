"""Stretches that do not fit: made on purpose, and found where they are."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.lab.audits.silent_breaks import find_silent_breaks

RATE_HZ = 10.0
TIMES_S = np.arange(400) / RATE_HZ


def way() -> np.ndarray:
    """Forty seconds of a bend that climbs, at about 1.2 m/s."""
    return np.stack([10 * np.cos(TIMES_S / 10), 12 * np.sin(TIMES_S / 10), 0.2 * TIMES_S], axis=1)


def broken(p: np.ndarray, q: np.ndarray) -> tuple[int, float | None]:
    found = find_silent_breaks(TIMES_S[: len(p)], p, q, 1 / RATE_HZ)
    assert found is not None
    assert found.broken is not None
    return found.broken, found.first_broken_s


def test_another_unit_and_frame_break_nothing() -> None:
    R = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert broken(0.37 * way() @ R.T + 5.0, way()) == (0, None)


def test_three_seconds_of_another_scale_are_found_where_they_are() -> None:
    steps = np.diff(way(), axis=0)
    steps[200:230] *= 0.5
    p = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    n, first_s = broken(p, way())
    # Stretches of 2 s every half second that lie in the 3 s by a good part.
    assert 3 <= n <= 9
    assert first_s == pytest.approx(20.0, abs=2.0)


def test_a_slow_drift_is_no_break() -> None:
    steps = np.diff(way(), axis=0) * np.linspace(1.0, 1.1, 399)[:, None]
    assert broken(np.vstack([np.zeros(3), np.cumsum(steps, axis=0)]), way()) == (0, None)


def test_a_jump_breaks_the_stretches_across_it() -> None:
    p = way()
    p[200:, 2] += 1.0
    n, first_s = broken(p, way())
    assert 3 <= n <= 4  # four stretches of 2 s hold any instant
    assert first_s == pytest.approx(18.5, abs=0.6)


def test_a_camera_that_hardly_moves_is_not_judged() -> None:
    q = 0.001 * way()
    found = find_silent_breaks(TIMES_S, np.random.default_rng(1).normal(size=q.shape), q, 1 / RATE_HZ)
    assert found is not None
    assert (found.judged, found.broken) == (0, None)


def test_too_few_poses_have_no_stretch() -> None:
    assert find_silent_breaks(TIMES_S[:19], way()[:19], way()[:19], 1 / RATE_HZ) is None
