"""The first of equal values."""

from __future__ import annotations

import numpy as np

from dualslam.core.types import BoolArray, IntArray


def is_first(values: IntArray) -> BoolArray:
    """Return (N,) which values have none like them before them."""
    first = np.zeros(len(values), bool)
    first[np.unique(values, return_index=True)[1]] = True
    return first
