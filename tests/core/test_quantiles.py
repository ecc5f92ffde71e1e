"""Medians and quantiles, against numpy's own."""

import numpy as np
import pytest

from dualslam.core.quantiles import median, quantile


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
