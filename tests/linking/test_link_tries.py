"""Tries at a link are counted, and the bound allows for them."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.core.types import FailureReason
from dualslam.recovery.schedule import RISK, LinkTries, tightened

MAX_SIGMA = 0.025


def test_the_first_try_passes_by_the_bound_as_it_stands() -> None:
    assert LinkTries({}).judge(0, 0.0249, MAX_SIGMA) is None
    assert tightened(MAX_SIGMA, 1) == pytest.approx(MAX_SIGMA)


@pytest.mark.parametrize("n", [2, 6, 12])
def test_the_bound_holds_the_risk_of_one_try_over_all_of_them(n: int) -> None:
    rng = np.random.default_rng(n)
    sigma = tightened(MAX_SIGMA, n)
    wrong = 1.96 * MAX_SIGMA
    worst = np.abs(sigma * rng.standard_normal((20_000, n))).max(axis=1)
    assert (worst > wrong).mean() < 1.1 * RISK


def test_after_refused_tries_it_must_pass_twice_in_a_row() -> None:
    tries = LinkTries({0: 2})
    for _ in range(3):
        tries.note_try(0, FailureReason.SCALE)
    again = tries.judge(0, 0.024, MAX_SIGMA)
    assert again is not None
    assert again.reason is FailureReason.UNCONFIRMED
    assert again.numbers["tries"] == 6
    tries.note_try(0, again.reason)
    assert tries.judge(0, 0.024, MAX_SIGMA) is None
    assert tries.refused[0] == 5


def test_what_fails_in_between_begins_anew_and_what_is_far_surer_passes_at_once() -> None:
    tries = LinkTries({0: 4})
    assert tries.judge(0, 0.024, MAX_SIGMA) is not None
    tries.note_try(0, FailureReason.AGREEMENT)
    assert tries.judge(0, 0.024, MAX_SIGMA) is not None
    assert LinkTries({0: 4}).judge(0, 0.015, MAX_SIGMA) is None
    assert LinkTries({0: 4}).judge(1, 0.024, MAX_SIGMA) is None


def test_what_held_in_one_walk_may_hold_again_in_the_next() -> None:
    known = LinkTries({0: 2, 1: 3})
    before, walk = known.copy(), known.copy()
    for _ in range(2):
        walk.note_try(0, FailureReason.SCALE)
    assert walk.judge(0, 0.024, MAX_SIGMA) is not None
    known.take_in(0, before, walk)
    assert known.refused == {0: 4, 1: 3}
    next_walk = known.copy()
    next_walk.note_try(1, FailureReason.SCALE)
    assert next_walk.judge(0, 0.024, MAX_SIGMA) is None
    assert next_walk.judge(1, 0.024, MAX_SIGMA) is not None
    assert known.refused[1] == 3


def test_the_tries_of_walks_that_were_under_way_at_once_add_up() -> None:
    known = LinkTries({0: 1})
    before, one, other = (known.copy() for _ in range(3))
    for _ in range(4):
        one.note_try(0, FailureReason.SCALE)
    other.note_try(0, FailureReason.SCALE_LOST)
    known.take_in(0, before, one)
    known.take_in(0, before, other)
    assert known.refused[0] == 6


def test_what_held_before_two_walks_and_failed_in_one_of_them_holds_no_more() -> None:
    known = LinkTries({0: 1})
    known.judge(0, 0.024, MAX_SIGMA)
    before, one, other = (known.copy() for _ in range(3))
    one.note_try(0, FailureReason.LEAP)
    known.take_in(0, before, one)
    known.take_in(0, before, other)  # it came to no try
    assert known.judge(0, 0.024, MAX_SIGMA) is not None
