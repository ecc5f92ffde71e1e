"""Points right before the camera have the longest lever: a pose goes by those alone that views enough have proven."""

from __future__ import annotations

import numpy as np

from dualslam.core.arrays import quantile
from dualslam.core.types import BoolArray, FloatArray

NEARER, NEAREST = 0.5, 0.05
"""Too near is what is nearer than so many times the depth of the nearest proven points (this share of them): the lever
is twice as long."""


def nearer_than_proven(depth: FloatArray, proven: BoolArray) -> BoolArray:
    """Return which points (N,) of depths (N,) are unproven, and nearer than any proof reaches; none where nothing is
    proven.

    On a scene that repeats itself wrong matches lie on the epipolar line, too, at any depth. Near ones weigh most: they
    hold the camera where it is, and a turn takes the place of its motion. Where true points are near, some are proven.
    """
    if not proven.any():
        return np.zeros(len(depth), np.bool_)
    return ~proven & stands_before(depth, depth[proven])


def stands_before(depth: FloatArray, others: FloatArray) -> BoolArray:
    """Return which points (N,) stand far before all but a few others (M,)."""
    return np.asarray(depth <= NEARER * quantile(others, NEAREST))
