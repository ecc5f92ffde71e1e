"""Guided matching, for any front end: descriptors are compared through `Frontend.distance` alone."""
from __future__ import annotations
import numpy as np
from numpy.typing import NDArray
from dualslam.core.types import IntArray


def rank_in_group(group: IntArray, cost: NDArray[np.generic]) -> IntArray:
    """Rank (0 is the best) of each row among the rows of its group, by ascending cost; ties by row.

    Parameters
    ----------
    group : (N,) int64
    cost : (N,)
    """
    order = np.lexsort((cost, group))
    position = np.arange(len(group))
    ordered = group[order]
    first = np.ones(len(group), np.bool_)
    first[1:] = ordered[1:] != ordered[:-1]
    rank = np.empty(len(group), np.int64)
    rank[order] = position - np.maximum.accumulate(np.where(first, position, 0))
    return rank
