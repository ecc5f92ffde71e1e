"""Guided matching, for any front end: descriptors are compared through `Frontend.distance` alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualslam.core.chi_square import CHI2_95
from dualslam.core.interfaces import Frontend
from dualslam.core.types import BoolArray, Features, FloatArray, IntArray, Matches
from dualslam.frontends.features.groups import NO_MATCHES, best_pairs, best_per_group, consistent_rotation

EPIPOLE_PX = 10.0
"""Features nearer to the epipole of their image are passed over: no parallax there."""
EPIPOLAR_RATIO = 0.85
"""Greatest best distance over second best on an epipolar line, in the best one's octave."""


@dataclass(frozen=True, slots=True, eq=False)
class FeatureGrid:
    """Features sorted into square cells, row by row, so that a disc is a few contiguous runs of the sorted list."""

    uv_px: FloatArray  # (N, 2): the features' positions, in their own order
    cell_px: float
    origin_px: FloatArray  # (2,): corner of the first cell
    shape: tuple[int, int]  # cell rows and columns
    order: IntArray  # (N,): feature rows sorted by cell
    start: IntArray  # (rows * columns + 1,): where each cell begins in `order`

    @classmethod
    def build(cls, uv_px: FloatArray, cell_px: float = 16.0) -> FeatureGrid:
        """Sort features into cells.

        - `uv_px` (N, 2): usually `features.uv_rect_px`. Non-finite positions are never found.
        - `cell_px`: about the usual search radius.
        """
        finite = np.flatnonzero(_are_finite(uv_px))
        u, v = uv_px.T.take(finite, axis=1)  # columns of their own: three times as fast
        (left, right), (top, bottom) = ((each.min(), each.max()) if len(each) else (0.0, 0.0) for each in (u, v))
        columns, rows = int((right - left) // cell_px) + 1, int((bottom - top) // cell_px) + 1
        column, row = np.minimum((u - left) / cell_px, columns - 1), np.minimum((v - top) / cell_px, rows - 1)
        flat = row.astype(np.int64) * columns + column.astype(np.int64)
        start = np.zeros(rows * columns + 1, np.int64)
        np.cumsum(np.bincount(flat, minlength=rows * columns), out=start[1:])
        order = finite[np.argsort(flat, kind="stable")]
        return cls(uv_px, cell_px, np.array([left, top]), (rows, columns), order, start)

    def within(self, uv_px: FloatArray, radius_px: FloatArray) -> tuple[IntArray, IntArray]:
        """Every feature in a disc around each position.

        - `radius_px` (M,).
        - `uv_px` (M, 2): non-finite positions find nothing.

        Returns query, feature : (P,) int64: rows of `uv_px` (ascending) and of the features.
        """
        asked = np.flatnonzero(_are_finite(uv_px) & (radius_px >= 0))
        at, reach = uv_px[asked], radius_px[asked]
        low = _cells(at - reach[:, None], self.origin_px, self.cell_px, self.shape)
        high = _cells(at + reach[:, None], self.origin_px, self.cell_px, self.shape)
        # A disc touches a run of cells in each of its cell rows: first one entry per (query, cell row), ...
        which, cell_row = _ranges(low[:, 1], high[:, 1] + 1)
        first = cell_row * self.shape[1]
        begin = self.start[first + low[which, 0]]
        end = self.start[first + high[which, 0] + 1]
        # ... then one per feature of the run.
        run, place = _ranges(begin, end)
        row, feature = which[run], self.order[place]
        du, dv = (self.uv_px[:, axis][feature] - at[:, axis][row] for axis in (0, 1))
        inside = np.flatnonzero(du * du + dv * dv <= (reach * reach)[row])
        return asked[row[inside]], feature[inside]


def match_projected(
    frontend: Frontend,
    grid: FeatureGrid,
    features: Features,
    uv_pred: FloatArray,
    radius_px: NDArray[np.floating[Any]],
    descriptors: NDArray[np.generic],
    *,
    octave: IntArray | FloatArray | None = None,
    max_distance: float | None = None,
    ratio: float = 0.9,
    taken: BoolArray | None = None,
    angle_rad: FloatArray | None = None,
) -> Matches:
    """Match points whose positions in an image are predicted to its features, one to one.

    - `grid`: of `features.uv_rect_px`.
    - `features`: of the image, N of them.
    - `uv_pred` (M, 2): predicted pixels, rectified; non-finite rows stay unmatched.
    - `radius_px` (M,): search radius.
    - `descriptors` (M, D): of the predicted points.
    - `octave` (M,): predicted pyramid level, may be fractional; features more than one from it are passed over.
    - `max_distance`: `frontend.max_distance` by default.
    - `ratio`: greatest best distance over second best, among the candidates of the best one's octave. 1: no test.
    - `taken` (N,) bool: features that may not be chosen.
    - `angle_rad` (M,): orientation of the predicted points where they were seen before: pairs that do not share the
      common rotation are dropped.

    Returns Matches: rows of `uv_pred` (ascending), rows of `features`.
    """
    query, feature = grid.within(uv_pred, np.asarray(radius_px, np.float64))
    usable = np.ones(len(query), np.bool_)
    if octave is not None:
        usable &= np.abs(features.octave[feature] - octave[query]) <= 1.0
    if taken is not None:
        usable &= ~taken[feature]
    query, feature = query[usable], feature[usable]
    if len(query) == 0:
        return NO_MATCHES
    limit = frontend.max_distance if max_distance is None else max_distance
    # `take`: of rows of several columns ten times as fast as an index in brackets.
    distance = frontend.distance(descriptors.take(query, axis=0), features.descriptors.take(feature, axis=0))
    chosen = best_pairs(query, feature, distance, features.octave[feature], ratio, len(uv_pred), len(features))
    chosen = chosen[distance[chosen] <= limit]
    if angle_rad is not None:
        turn = features.angle_rad[feature[chosen]] - angle_rad[query[chosen]]
        chosen = chosen[consistent_rotation(turn)]
    return Matches(np.stack([query[chosen], feature[chosen]], axis=1), distance[chosen])


def match_epipolar(
    frontend: Frontend,
    a: Features,
    b: Features,
    rows_a: IntArray,
    rows_b: IntArray,
    F_b_a: FloatArray,
    *,
    octave_tolerance: int = 1,
) -> Matches:
    """Match features of two keyframes of known relative pose, along epipolar lines, one to one.

    A pair is a candidate if the feature of b lies on the epipolar line of that of a, and the octaves are close. The
    tolerance is the 95 % gate of both features' noise. Of the candidates, pairs are kept that are best for each other,
    clearly so, and share the common change of orientation.

    - `rows_a` (A,), `rows_b` (B,): features that take part, usually those without a landmark.
    - `F_b_a` (3, 3): fundamental matrix on rectified pixels: the line in b of x_a is ``F_b_a @ x_a``, its sign and
      scale are free.

    Returns Matches: rows of `a` (ascending in the order of `rows_a`), rows of `b`.
    """
    uv_a, uv_b = a.uv_rect_px[rows_a], b.uv_rect_px[rows_b]
    first, second = _near_lines(
        uv_a, uv_b, a.sigma_px[rows_a], b.sigma_px[rows_b], a.octave[rows_a], b.octave[rows_b], F_b_a, octave_tolerance
    )
    usable = _off_epipole(uv_a, F_b_a)[first] & _off_epipole(uv_b, F_b_a.T)[second]
    first, second = first[usable], second[usable]
    if len(first) == 0:
        return NO_MATCHES
    distance = frontend.distance(a.descriptors.take(rows_a[first], axis=0), b.descriptors.take(rows_b[second], axis=0))
    octave_b = b.octave[rows_b[second]]
    chosen = best_pairs(first, second, distance, octave_b, EPIPOLAR_RATIO, len(rows_a), len(rows_b))
    # Best for b among all candidates, not only among those that are some feature's best.
    chosen = np.intersect1d(chosen, best_per_group(second, distance, len(rows_b)), assume_unique=True)
    chosen = chosen[distance[chosen] <= frontend.max_distance]
    index = np.stack([rows_a[first[chosen]], rows_b[second[chosen]]], axis=1)
    kept = consistent_rotation(b.angle_rad[index[:, 1]] - a.angle_rad[index[:, 0]])
    return Matches(index[kept], distance[chosen][kept])


def _are_finite(uv_px: FloatArray) -> BoolArray:
    """Which positions (N, 2) are finite: column by column, as numpy is slow along rows of two."""
    return np.isfinite(uv_px[:, 0]) & np.isfinite(uv_px[:, 1])


def _cells(uv_px: FloatArray, origin_px: FloatArray, cell_px: float, shape: tuple[int, int]) -> IntArray:
    """Cell (column, row) of each position, those outside moved to the rim: (N, 2)."""
    last = np.array([shape[1] - 1, shape[0] - 1], np.float64)
    return np.clip((uv_px - origin_px) / cell_px, 0.0, last).astype(np.int64)


def _ranges(begin: IntArray, end: IntArray) -> tuple[IntArray, IntArray]:
    """All integers of the ranges [begin, end), one after the other, and the row of the range each belongs to."""
    length = end - begin
    row = np.repeat(np.arange(len(length)), length)
    offset = np.cumsum(length) - length
    return row, np.arange(len(row)) + (begin - offset)[row]


def _near_lines(
    uv_a: FloatArray,
    uv_b: FloatArray,
    sigma_a: FloatArray,
    sigma_b: FloatArray,
    octave_a: IntArray,
    octave_b: IntArray,
    F_b_a: FloatArray,
    octave_tolerance: int,
) -> tuple[IntArray, IntArray]:
    """Pairs of like octave whose point in b is within the 95 % gate of the line of the point in a, ascending in a.

    Octave by octave: of eight octaves, one and those next to it are a third of all pairs.
    """
    order_a, order_b = np.argsort(octave_a, kind="stable"), np.argsort(octave_b, kind="stable")
    lines = np.concatenate([uv_a, np.ones((len(uv_a), 1))], axis=1)[order_a] @ F_b_a.T
    normal = np.hypot(lines[:, 0], lines[:, 1])
    lines /= np.where(normal > 0, normal, np.nan)[:, None]
    # Single precision: with unit normals the products stay below some thousands, so the error is about 1e-3 px.
    lines = lines.astype(np.float32)
    points = np.concatenate([uv_b, np.ones((len(uv_b), 1))], axis=1)[order_b].astype(np.float32).T
    # The noise of a's pixel moves the line by about as much as it moves the pixel.
    gate_a = (CHI2_95[1] * sigma_a[order_a] ** 2).astype(np.float32)[:, None]
    gate_b = (CHI2_95[1] * sigma_b[order_b] ** 2).astype(np.float32)
    octaves = np.unique(octave_a)
    begin_a, end_a = (np.searchsorted(octave_a[order_a], octaves, side).tolist() for side in ("left", "right"))
    sorted_b = octave_b[order_b]
    begin_b = np.searchsorted(sorted_b, octaves - octave_tolerance, "left").tolist()
    end_b = np.searchsorted(sorted_b, octaves + octave_tolerance, "right").tolist()
    first, second = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for a0, a1, b0, b1 in zip(begin_a, end_a, begin_b, end_b, strict=True):
        off_line = lines[a0:a1] @ points[:, b0:b1]
        off_line *= off_line
        off_line -= gate_b[b0:b1]
        near = np.flatnonzero(off_line <= gate_a[a0:a1])
        row = near // max(b1 - b0, 1)
        first.append(order_a[row + a0])
        second.append(order_b[near - row * (b1 - b0) + b0])
    rows_a, rows_b = np.concatenate(first), np.concatenate(second)
    if (np.diff(octave_a) < 0).any() or (np.diff(octave_b) < 0).any():  # not given octave by octave
        order = np.lexsort((rows_b, rows_a))
        rows_a, rows_b = rows_a[order], rows_b[order]
    return rows_a, rows_b


def _off_epipole(uv_px: FloatArray, F_other: FloatArray) -> BoolArray:
    """Which points of an image are not beside its epipole, the null vector of `F_other` (which maps its points)."""
    epipole = np.linalg.svd(F_other)[2][-1]
    if abs(epipole[2]) < 1e-9:
        return np.ones(len(uv_px), np.bool_)
    off: BoolArray = np.hypot(*(uv_px - epipole[:2] / epipole[2]).T) > EPIPOLE_PX
    return off
