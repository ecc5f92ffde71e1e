"""Rows of arrays."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.core.arrays import is_first, median, quantile, sum_by


def test_the_first_of_each_is_told() -> None:
    assert is_first(np.array([3, 1, 3, 2, 1, 3])).tolist() == [True, True, False, True, False, False]
    assert is_first(np.zeros(0, np.int64)).tolist() == []


def test_sum_by_is_numpys_to_the_bit() -> None:
    rng = np.random.default_rng(0)
    index, values = rng.integers(0, 7, 200), rng.normal(size=(200, 3, 2))
    expected = np.zeros((9, 3, 2))  # the last two have no rows
    np.add.at(expected, index, values)
    np.testing.assert_array_equal(sum_by(index, values, 9), expected)


def test_no_rows_sum_to_zero() -> None:
    none = np.zeros(0, np.int64)
    for shape in ((), (3,), (3, 2)):
        np.testing.assert_array_equal(sum_by(none, np.empty((0, *shape)), 4), np.zeros((4, *shape)))


@pytest.mark.parametrize("n", [1, 2, 3, 8, 59, 60, 301])
def test_they_are_numpys_to_the_bit(n: int) -> None:
    rng = np.random.default_rng(n)
    for _ in range(50):
        values = rng.normal(size=n) * 10.0 ** rng.uniform(-3, 3)
        assert median(values) == np.median(values)
        table = rng.normal(size=(n, 6))
        for share in (0.0, 0.05, 0.1, 0.5, 0.9, 1.0):
            assert quantile(values, share) == np.quantile(values, share)
            np.testing.assert_array_equal(quantile(table, share), np.quantile(table, share, axis=0))


def test_what_is_given_stays_as_it_was() -> None:
    values = np.array([3.0, 1.0, 2.0])
    assert (median(values), float(quantile(values, 0.9))) == (2.0, 2.8)
    assert values.tolist() == [3.0, 1.0, 2.0]
