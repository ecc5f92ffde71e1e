"""Medians and quantiles of a few numbers: numpy's to the bit, without what it spends on every other case."""

from __future__ import annotations

import numpy as np

from dualslam.core.types import FloatArray


def median(values: FloatArray) -> float:
    """Return the median of (N,) finite values, N > 0 (of 300 in 6 us; `numpy.median` takes 27)."""
    middle = (len(values) - 1) // 2, len(values) // 2
    parted = np.partition(values, middle)
    return 0.5 * float(parted[middle[0]] + parted[middle[1]])


def quantile(values: FloatArray, share: float) -> FloatArray:
    """Return the quantiles of finite values (N, ...) along the first axis, N > 0, between neighbours on a line."""
    at = (len(values) - 1) * share
    low = int(at)
    high, t = min(low + 1, len(values) - 1), at - low
    parted = np.partition(values, (low, high), axis=0)
    below, above = parted[low], parted[high]
    between = above - (above - below) * (1.0 - t) if t >= 0.5 else below + (above - below) * t
    return np.asarray(between, np.float64)
