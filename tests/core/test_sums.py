"""Sums of rows that belong together, against numpy's own."""

import numpy as np

from dualslam.core.sums import sum_by


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
