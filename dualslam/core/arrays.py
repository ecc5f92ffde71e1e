"""Rows of arrays: medians, sums by index, the first of equal ones; dataclasses whose fields are columns."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from dualslam.core.types import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

ColumnsT = TypeVar("ColumnsT", bound="DataclassInstance")


def is_first(values: IntArray) -> BoolArray:
    """Return (N,) which values have none like them before them."""
    first = np.zeros(len(values), bool)
    first[np.unique(values, return_index=True)[1]] = True
    return first


def first_in_both(a: IntArray, b: IntArray) -> IntArray:
    """Return rows of a greedy one-to-one selection of pairs (a, b) that stand in order of preference."""
    rows = np.arange(len(a))
    kept: list[IntArray] = []
    while len(rows):
        chosen = rows[is_first(a[rows]) & is_first(b[rows])]
        kept.append(chosen)
        rows = rows[~np.isin(a[rows], a[chosen]) & ~np.isin(b[rows], b[chosen])]
    return np.sort(np.concatenate(kept)) if kept else rows


def rank_in_runs(group: IntArray) -> IntArray:
    """Place of each row in its run of equal values, from 0: sorted by group and cost, that is the rank in the group."""
    place = np.arange(len(group))
    starts = np.concatenate([[True], group[1:] != group[:-1]])[: len(group)]
    rank: IntArray = place - np.maximum.accumulate(np.where(starts, place, 0))
    return rank


def sum_by(index: IntArray, values: FloatArray, n: int) -> FloatArray:
    """Return (n, ...): the sum of the rows of each index (`numpy.add.at` takes several times as long)."""
    flat = values.reshape(len(values), math.prod(values.shape[1:]))  # -1 is not known where there is no row
    sums = np.empty((n, flat.shape[1]))
    for column in range(flat.shape[1]):
        sums[:, column] = np.bincount(index, flat[:, column], n)
    return sums.reshape(n, *values.shape[1:])


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


def concatenate(parts: Sequence[ColumnsT]) -> ColumnsT:
    """Return the rows of several such dataclasses of one type (at least one of them), one after the other."""
    names = [field.name for field in fields(parts[0])]
    return type(parts[0])(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
