"""Sums of rows that belong together."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.core.sums import sum_by


@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
@pytest.mark.parametrize("n_rows", [0, 1, 50])
def test_is_add_at(shape: tuple[int, ...], n_rows: int) -> None:
    rng = np.random.default_rng(n_rows)
    index, values = rng.integers(0, 7, n_rows), rng.normal(size=(n_rows, *shape))
    expected = np.zeros((9, *shape))
    np.add.at(expected, index, values)
    np.testing.assert_allclose(sum_by(index, values, 9), expected, atol=1e-12)
