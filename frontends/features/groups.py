"""Choosing among candidate pairs: the best of each group, mutual bests, and pairs that agree on a rotation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from dualslam.core.interfaces import Frontend
from dualslam.core.types import BoolArray, FloatArray, IntArray, Matches

ROWS_AT_ONCE = 128
"""Of a matrix that is made to be looked through and dropped: with 1,500 columns of four bytes they stay in a core's
cache, and the whole takes four fifths of the time."""
TURN_TOLERANCE_RAD = np.radians(30.0)
"""Greatest departure of a pair from the rotation that most share."""
MIN_TURNS = 8
"""With fewer pairs all are kept: there is no majority to ask."""
NO_MATCHES = Matches(np.empty((0, 2), np.int64), np.empty(0))


def lowest_in_group(group: IntArray, cost: FloatArray, n_groups: int) -> FloatArray:
    """Least cost of each group, (n_groups,); infinite for a group without rows."""
    lowest = np.full(n_groups, np.inf)
    np.minimum.at(lowest, group, cost)
    return lowest


def best_per_group(group: IntArray, cost: FloatArray, n_groups: int) -> IntArray:
    """Row of the least cost in each group, ascending; ties go to the earlier row, infinite costs are never chosen.

    - `cost` (N,); `group` (N,): in [0, n_groups).

    Returns (G,) int64: rows, one for each group that has a finite cost.
    """
    lowest = lowest_in_group(group, cost, n_groups)
    candidates = np.flatnonzero((cost == lowest[group]) & np.isfinite(cost))
    chosen = np.full(n_groups, -1)
    chosen[group[candidates[::-1]]] = candidates[::-1]  # the last assignment stands: the earliest row
    return np.sort(chosen[chosen >= 0])


def best_pairs(
    first: IntArray, second: IntArray, cost: FloatArray, rival: IntArray, ratio: float, n_first: int, n_second: int
) -> IntArray:
    """One-to-one choice among candidate pairs: best for the first, clearly so, then best for the second.

    - `cost` (P,).
    - `first`, `second` (P,): the two members of each pair.
    - `rival` (P,): class of the second member. The ratio test compares the best one with candidates of its class alone:
      a corner seen in two octaves must not compete with itself.
    - `ratio`: the best cost must not exceed this share of the second best; 1 switches the test off.

    Returns (M,) int64: rows of the chosen pairs, ascending in `first` where the pairs are.
    """
    best = best_per_group(first, cost, n_first)
    if ratio < 1.0:
        best_row = np.full(n_first, -1)
        best_row[first[best]] = best
        rivals = best_row[first]
        is_rival = (rivals >= 0) & (rivals != np.arange(len(first))) & (rival == rival[rivals])
        runner_up = lowest_in_group(first[is_rival], cost[is_rival], n_first)
        best = best[cost[best] <= ratio * runner_up[first[best]]]
    return best[best_per_group(second[best], cost[best], n_second)]


@dataclass(frozen=True, slots=True, eq=False)
class Nearest:
    """The nearest of M columns to each of N rows: which it is (the first of equals), how near, and the next one too."""

    column: IntArray
    distance: NDArray[Any]
    runner_up: NDArray[Any]


def nearest(distances: NDArray[Any]) -> Nearest:
    """Return what is nearest to each row of a dense matrix (N, M) of uint16, int32 or float, M > 0."""
    rows = np.arange(len(distances))
    columns = distances.argmin(axis=1)
    best = distances[rows, columns]
    # The runner-up, with the best hidden meanwhile: cheaper than a partition, or than a copy of the rows asked for.
    distances[rows, columns] = _highest(distances.dtype)
    runner_up = distances.min(axis=1)
    distances[rows, columns] = best
    return Nearest(columns, best, runner_up)


def nearest_by_parts(n_rows: int, distances: Callable[[slice], NDArray[Any]]) -> Nearest:
    """Return `nearest` of a matrix that is made part by part, `ROWS_AT_ONCE` each; `distances` returns some rows."""
    parts = [nearest(distances(slice(begin, begin + ROWS_AT_ONCE))) for begin in range(0, n_rows, ROWS_AT_ONCE)]
    columns, best, runners_up = zip(*((part.column, part.distance, part.runner_up) for part in parts), strict=True)
    return Nearest(np.concatenate(columns), np.concatenate(best), np.concatenate(runners_up))


def mutual(near: Nearest, ratio: float, max_distance: float, nearest_rows: Callable[[IntArray], IntArray]) -> Matches:
    """One-to-one matches of rows to what is nearest to them: near enough, clearly nearest, and they to it.

    - `ratio`: greatest best distance over second best, row-wise.
    - `nearest_rows`: returns which row is nearest to each of some columns, the first of equals.
    """
    rows = np.flatnonzero((near.distance <= max_distance) & (near.distance <= ratio * near.runner_up))
    if len(rows):
        rows = rows[nearest_rows(near.column[rows]) == rows]
    return Matches(np.stack([rows, near.column[rows]], axis=1), near.distance[rows].astype(np.float64))


def mutual_best(distances: NDArray[Any], ratio: float, max_distance: float) -> Matches:
    """Return `mutual` matches of a dense distance matrix (N, M)."""
    if 0 in distances.shape:
        return NO_MATCHES
    return mutual(nearest(distances), ratio, max_distance, lambda asked: distances.take(asked, axis=1).argmin(axis=0))


def _highest(kind: np.dtype[Any]) -> float:
    return float(np.iinfo(kind).max) if np.issubdtype(kind, np.integer) else np.inf


def consistent_rotation(turn_rad: FloatArray) -> BoolArray:
    """Which pairs agree with the rotation that most of them share.

    `turn_rad` (M,): orientation in the second image minus that in the first, any winding.
    """
    if len(turn_rad) < MIN_TURNS:
        return np.ones(len(turn_rad), np.bool_)
    bin_rad = 2 * np.pi / 30
    histogram = np.bincount((turn_rad % (2 * np.pi) / bin_rad).astype(np.int64) % 30, minlength=30)
    around = np.concatenate([histogram[-1:], histogram, histogram[:1]])
    peak = int(np.argmax(2 * histogram + around[:-2] + around[2:]))
    # The mean around the peak, so that the window does not depend on where the bins happen to lie.
    from_peak = _wrapped(turn_rad - (peak + 0.5) * bin_rad)
    centre = from_peak[np.abs(from_peak) <= 1.5 * bin_rad].mean()
    kept: BoolArray = np.abs(_wrapped(from_peak - centre)) <= TURN_TOLERANCE_RAD
    return kept


def _wrapped(angle_rad: FloatArray) -> FloatArray:
    """The same angles in [-pi, pi)."""
    wrapped: FloatArray = (angle_rad + np.pi) % (2 * np.pi) - np.pi
    return wrapped


@runtime_checkable
class AllPairs(Protocol):
    """A front end that compares all with all in less time than pair by pair."""

    def distances(self, a: NDArray[np.generic], b: NDArray[np.generic]) -> FloatArray:
        """Distances of descriptors (N, D), (M, D) -> (N, M), each to the bit what `Frontend.distance` says."""
        ...


def all_distances(frontend: Frontend, a: NDArray[np.generic], b: NDArray[np.generic]) -> FloatArray:
    """Return the distances (N, M) of descriptors (N, D) to others (M, D), N > 0."""
    if isinstance(frontend, AllPairs):
        return frontend.distances(a, b)
    return np.stack([frontend.distance(np.broadcast_to(row, b.shape), b) for row in a])
