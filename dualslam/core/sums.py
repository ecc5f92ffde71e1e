"""Sums of array rows that belong together."""

from __future__ import annotations

import math

import numpy as np

from dualslam.core.types import FloatArray, IntArray


def sum_by(index: IntArray, values: FloatArray, n: int) -> FloatArray:
    """Return (n, ...): the sum of the rows of each index (`numpy.add.at` takes several times as long)."""
    flat = values.reshape(len(values), math.prod(values.shape[1:]))  # -1 is not known where there is no row
    sums = np.empty((n, flat.shape[1]))
    for column in range(flat.shape[1]):
        sums[:, column] = np.bincount(index, flat[:, column], n)
    return sums.reshape(n, *values.shape[1:])
