"""Critical doses of made-up failures whose curve is known."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.lab.metrics.dose_response import critical_dose


def failures(centre: float, slope: float, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    doses = rng.uniform(0, 10, n)
    return doses, rng.random(n) < 1 / (1 + np.exp(-slope * (doses - centre)))


def test_the_centre_of_the_curve_is_found() -> None:
    found = critical_dose(*failures(4.0, 1.5, 500, 1))
    assert found is not None
    assert found.value == pytest.approx(4.0, abs=0.3)


def test_the_interval_holds_the_truth_as_often_as_it_says() -> None:
    held = 0
    for seed in range(100):
        found = critical_dose(*failures(6.0, 1.2, 40, seed))
        assert found is not None
        held += found.interval.low <= 6.0 <= found.interval.high
    assert 88 <= held <= 100  # of 95; 2.9 standard deviations below


def test_doses_that_separate_the_failures_bracket_it() -> None:
    doses = np.array([1.0, 2.0, 3.0, 7.0, 8.0, 9.0])
    found = critical_dose(doses, doses > 5)
    assert found is not None
    assert found.value == pytest.approx(5.0, abs=0.2)
    assert 1.0 <= found.interval.low < 3.0
    assert 7.0 < found.interval.high <= 9.0


def test_a_dose_outside_of_those_tried_is_not_claimed() -> None:
    doses = np.linspace(1, 5, 20)
    never, always = critical_dose(doses, np.zeros(20, bool)), critical_dose(doses, np.ones(20, bool))
    assert never is not None
    assert always is not None
    assert (never.value, never.is_above, never.is_below) == (None, True, False)
    assert (always.value, always.is_above, always.is_below) == (None, False, True)
    assert critical_dose([2.0, 2.0], [True, False]) is None
