"""Equal values: the first of each, and the rank within a run of them."""

from __future__ import annotations

import numpy as np

from dualslam.core.types import BoolArray, IntArray


def is_first(values: IntArray) -> BoolArray:
    """Return (N,) which values have none like them before them."""
    first = np.zeros(len(values), bool)
    first[np.unique(values, return_index=True)[1]] = True
    return first


def rank_in_runs(group: IntArray) -> IntArray:
    """Place of each row in its run of equal values, from 0: sorted by group and cost, that is the rank in the group."""
    place = np.arange(len(group))
    starts = np.concatenate([[True], group[1:] != group[:-1]])[: len(group)]
    rank: IntArray = place - np.maximum.accumulate(np.where(starts, place, 0))
    return rank
