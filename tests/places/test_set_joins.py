"""Which place joins two sets of maps: one that is sure, confirmed by other keyframes, and not contradicted by most."""

from __future__ import annotations

import numpy as np

from dualslam.core.geometry import sim3
from dualslam.core.types import Failure, FailureReason, FloatArray
from dualslam.places.set_joins import _join_of, _Shared
from dualslam.places.verification import PlaceMatch

HERE, ELSEWHERE = (sim3.from_parts(2.0, np.eye(3), np.array([x, 0.0, 0.0])) for x in (0.0, 5.0))
LOOSE = Failure(FailureReason.SCALE, "scale known to 3.0%")


def shared(a: int, b: int, S_a_b: FloatArray = HERE, sigma: float = 0.01, doubt: Failure | None = None) -> _Shared:
    """Return a place that keyframe `a` of one set and `b` of the other show."""
    match = PlaceMatch(
        (0, a), (1, b), S_a_b, np.eye(7), np.zeros((0, 2), int), (), (), 50, 40, {"sigma_scale": sigma}, doubt
    )
    T_b_cam = np.eye(4)
    T_b_cam[0, 3] = 0.01 * b
    return _Shared(match, (a, b), S_a_b, T_b_cam, within=0.5)


def test_the_surest_place_that_two_more_keyframes_confirm() -> None:
    join = _join_of([shared(1, 100), shared(1, 101, sigma=0.005), shared(40, 130)])
    assert join is not None
    assert join.confirmations == 2
    assert join.match.query == (1, 101)


def test_keyframes_of_either_set_confirm() -> None:
    assert _join_of([shared(k, 100) for k in (1, 2, 3)]) is not None


def test_the_same_keyframes_confirm_nothing() -> None:
    assert _join_of([shared(1, 100), shared(1, 101), shared(2, 100), shared(2, 101)]) is None


def test_a_place_of_unsure_scale_confirms_and_does_not_join() -> None:
    loose = [shared(1, 100, doubt=LOOSE), shared(1, 101, doubt=LOOSE)]
    assert _join_of([*loose, shared(1, 102, doubt=LOOSE)]) is None
    join = _join_of([*loose, shared(40, 130)])
    assert join is not None
    assert join.match.query == (1, 130)


def test_most_keyframes_must_agree() -> None:
    here = [shared(1, 100 + n) for n in range(3)]
    elsewhere = [shared(30, 200 + n, ELSEWHERE) for n in range(2)]
    assert _join_of(here + elsewhere) is not None
    scattered = [
        shared(60, 300 + n, sim3.from_parts(2.0, np.eye(3), np.array([0.0, 9.0 * n + 9.0, 0.0]))) for n in range(4)
    ]
    assert _join_of(here + scattered) is None
