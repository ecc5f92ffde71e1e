"""Well-spread FAST corners on one pyramid level, and a sub-pixel step for them. Knows nothing of descriptors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from operator import attrgetter

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from dualslam.core.arrays import rank_in_runs
from dualslam.core.noise_model import GATE_SIGMAS
from dualslam.core.types import BoolArray, FloatArray, IntArray

FAST_RADIUS_PX = 3
"""FAST reads a circle of this radius, so it finds nothing nearer to the edge of what it is given."""
MIN_CURVATURE = 0.01
"""Grey levels per square pixel: below that the peak is made of rounding."""
_DOG_SIGMAS_PX = (1.0, 1.6)
"""Wide enough to be smooth under FAST's noise, narrow enough to stay at the corner."""
_DOG_REACH_PX = 6
"""Radius of the filter."""
_DOG_CURVATURE_NOISE = 0.165
"""Standard deviation of the filter's second difference along an axis, relative to that of white noise in the image."""

_ROW_BITS = 24
_ROW_MASK = (1 << _ROW_BITS) - 1
"""Of a sort key, its row: an image has fewer corners than 16 million."""


def detect_corners(
    image: NDArray[np.uint8],
    thresholds: Sequence[int],
    margin_px: int,
    cell_px: int,
    known: tuple[IntArray, FloatArray] | None = None,
) -> tuple[IntArray, FloatArray]:
    """FAST corners of one pyramid level: the first threshold everywhere, lower ones only in cells still empty.

    - `image` (H, W) uint8.
    - `thresholds`: grey-level contrasts, descending.
    - `margin_px`: width of the rim without corners, >= 3.
    - `cell_px`: side of the square cells in which emptiness is judged.
    - `known`: what was found with higher thresholds: all of `thresholds` are tried in empty cells alone.

    Returns pixels (N, 2) int64 (column, row), and FAST scores (N,): the largest threshold at which each is a corner.
    """
    height, width = image.shape
    if min(height, width) <= 2 * margin_px:
        return np.empty((0, 2), np.int64), np.empty(0)
    window = (margin_px, margin_px, width - margin_px, height - margin_px)
    xy, response = _fast(image, thresholds[0], [window]) if known is None else known
    for threshold in thresholds[known is None :]:
        windows = _empty_runs(_occupied_cells(xy, window, cell_px), window, cell_px)
        found = _fast(image, threshold, windows)
        xy, response = np.concatenate([xy, found[0]]), np.concatenate([response, found[1]])
    return xy, response


def select_spread(xy: IntArray, response: FloatArray, n_wanted: int) -> IntArray:
    """Choose corners that are strong and cover the level: the best of each cell first, then the second best, ...

    The cells are as many as the corners wanted, over the corners' bounding box.

    - `xy` (N, 2); `response` (N,): strength, whole numbers below 256.

    Returns (min(N, n_wanted),) int64: rows, ascending.
    """
    if len(xy) <= n_wanted:
        return np.arange(len(xy))
    if n_wanted == 0:
        return np.empty(0, np.int64)
    u, v = xy.T.copy()  # numpy is several times as fast along rows of their own
    u -= u.min()
    v -= v.min()
    width, height = int(u.max()) + 1, int(v.max()) + 1
    cell_px = max(1.0, float(np.sqrt(width * height / n_wanted)))
    column, row = ((each / cell_px).astype(np.int64) for each in (u, v))
    cell = row * int(width / cell_px + 1) + column
    # FAST scores are whole numbers below 256, so one integer key sorts by two things at once. The row in its last bits
    # makes it unique, so any sort does: numpy's quickest is ten times as fast as its stable one. Ties go to the earlier
    # corner, and the choice depends on nothing but the image.
    rows = np.arange(len(xy))
    weakness = 256 - response.astype(np.int64)
    by_cell = np.sort(((cell * 512 + weakness) << _ROW_BITS) | rows) & _ROW_MASK
    rank = rank_in_runs(cell[by_cell])
    by_rank = np.partition(((rank * 512 + weakness[by_cell]) << _ROW_BITS) | rows, n_wanted - 1)[:n_wanted] & _ROW_MASK
    return np.sort(by_cell[by_rank])


def grades(response: FloatArray) -> FloatArray:
    """Responses of any kind as whole numbers from 0 to 255, equally many of each, for `select_spread`."""
    rank = np.empty(len(response))
    rank[np.argsort(response, kind="stable")] = np.arange(len(response))
    return np.floor(rank * 256 / max(len(response), 1))


def share_out(n_available: Sequence[int], weights: FloatArray, n_wanted: int) -> list[int]:
    """Divide `n_wanted` among levels by weight; what a poor level cannot fill goes to the others, finest first.

    - `n_available`: corners of each level.
    - `weights` (L,): positive; only their ratios count.
    """
    available = np.asarray(n_available, np.int64)
    quota = np.zeros(len(available), np.int64)
    n_wanted = min(n_wanted, int(available.sum()))
    while (left := n_wanted - int(quota.sum())) > 0:
        open_weight = np.where(quota < available, weights[: len(available)], 0.0)
        extra = np.floor(left * open_weight / open_weight.sum()).astype(np.int64)
        if not extra.any():
            extra[np.flatnonzero(open_weight)[:left]] = 1
        quota = np.minimum(quota + extra, available)
    return [int(each) for each in quota]


@dataclass(frozen=True, slots=True, eq=False)
class Peaks:
    """Differences of Gaussians around the corners, shared by the sub-pixel step and its doubts."""

    response: NDArray[np.float32]
    """(N, 3, 3) float32: about its extremum beside each corner, turned so that the extremum is a maximum."""
    middle: IntArray  # (N, 2): where the extremum is, (du, dv) from the corner in whole pixels


def find_peaks(patches: NDArray[np.uint8]) -> Peaks:
    """Return what a difference of Gaussians does beside the centres of patches (N, S, S) uint8, S odd and >= 17."""
    return Peaks(*_peaks(patches))


def refine_corners(peaks: Peaks) -> tuple[FloatArray, BoolArray]:
    """Sub-pixel offset from the centre of each patch to the extremum of a difference of Gaussians beside it.

    A FAST corner is a whole pixel, which noise chooses. The extremum is a smooth function of the image: it halves the
    median epipolar residual (KITTI, 7-Scenes: 0.31 to 0.13 px). Harris, minimal eigenvalue and Foerstner do not.

    Returns (du, dv) in pixels of the level (N, 2), at most 1.75 and zero where there is no extremum; and where one is.
    """
    offset, found = quadratic_peak(peaks.response, MIN_CURVATURE)
    offset += peaks.middle
    return np.where(found[:, None], offset, 0.0), found


def stand_out(peaks: Peaks, noise: FloatArray) -> BoolArray:
    """Which corners (N,) are placed by the scene, and not by the image's noise.

    In a soft image, and along an edge, the extremum of `refine_corners` curves no more than noise makes it.

    `noise` (N,) float64: its standard deviation about each of them, grey levels.
    """
    least = _least_curvature(peaks.response)
    return np.asarray(least > GATE_SIGMAS * _DOG_CURVATURE_NOISE * noise)


def _peaks(patches: NDArray[np.uint8]) -> tuple[NDArray[np.float32], IntArray]:
    """Difference of Gaussians about its extremum beside each patch's centre (N, 3, 3), upwards, and where that is."""
    centre, reach = patches.shape[1] // 2, _DOG_REACH_PX + 2
    part = slice(centre - reach, centre + reach + 1)
    grey = patches[:, part, part].astype(np.float32).reshape(len(patches), (2 * reach + 1) ** 2)
    response = (grey @ _dog_weights()).reshape(-1, 5, 5)
    response *= np.where(response[:, 2:3, 2:3] < 0, np.float32(-1), np.float32(1))
    v, u = np.divmod(response[:, 1:4, 1:4].reshape(-1, 9).argmax(axis=1), 3)
    peaks = sliding_window_view(response, (3, 3), axis=(1, 2))[np.arange(len(u)), v, u]
    return peaks, np.stack([u - 1, v - 1], axis=1)


def _least_curvature(response: NDArray[np.floating]) -> FloatArray:
    """By how much each 3 x 3 neighbourhood (N, 3, 3) curves downwards at its middle, where it does so least."""
    uu, vv, uv = _second_derivatives(response.astype(np.float64))
    return np.asarray(-(uu + vv) / 2 - np.hypot((uu - vv) / 2, uv))


def _second_derivatives(r: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Along u, along v and mixed, (N,) each, at the middle of 3 x 3 neighbourhoods (N, 3, 3)."""
    uu, vv = r[:, 1, 2] - 2 * r[:, 1, 1] + r[:, 1, 0], r[:, 2, 1] - 2 * r[:, 1, 1] + r[:, 0, 1]
    return uu, vv, (r[:, 2, 2] - r[:, 2, 0] - r[:, 0, 2] + r[:, 0, 0]) / 4


def quadratic_peak(response: NDArray[np.floating], min_curvature: float = 0.0) -> tuple[FloatArray, BoolArray]:
    """Maximum of the parabola through each 3 x 3 neighbourhood, and whether it lies within 0.75 px.

    - `response` (N, 3, 3): the middle is the highest, or nearly.
    - `min_curvature`: by so much a peak curves downwards at least, in both directions together.

    Returns (du, dv) from the middle (N, 2), anything where there is no such maximum; and where one is.
    """
    r = response.astype(np.float64)
    gradient_u, gradient_v = (r[:, 1, 2] - r[:, 1, 0]) / 2, (r[:, 2, 1] - r[:, 0, 1]) / 2
    uu, vv, uv = _second_derivatives(r)
    determinant = uu * vv - uv**2
    # Curved downwards in every direction.
    peaked = (determinant > 0) & (uu + vv < -min_curvature)
    safe = np.where(peaked, determinant, 1.0)
    offset = np.stack([uv * gradient_v - vv * gradient_u, uv * gradient_u - uu * gradient_v], axis=1) / safe[:, None]
    return offset, peaked & (np.abs(offset) <= 0.75).all(axis=1)


@lru_cache(maxsize=1)
def _dog_weights() -> NDArray[np.float32]:
    """((2 r + 1)^2, 25): the difference of Gaussians at each pixel of the 5 x 5 centre of a patch of radius r."""
    axis = np.arange(-_DOG_REACH_PX, _DOG_REACH_PX + 1)
    gaussians = [np.exp(-(axis**2) / (2 * sigma**2)) for sigma in _DOG_SIGMAS_PX]
    fine, coarse = (np.outer(each, each) / each.sum() ** 2 for each in gaussians)
    kernels = [np.pad(coarse - fine, ((row, 4 - row), (column, 4 - column))) for row in range(5) for column in range(5)]
    return np.stack(kernels, axis=-1).reshape(-1, 25).astype(np.float32)


def _fast(
    image: NDArray[np.uint8], threshold: int, windows: Sequence[tuple[int, int, int, int]]
) -> tuple[IntArray, FloatArray]:
    """FAST corners inside windows (left, top, right, bottom, the last two exclusive), in pixels of the image.

    One window after the other; what OpenCV finds is taken into numpy at once, since that costs more than to find it.
    """
    rim, detector = FAST_RADIUS_PX, cv2.FastFeatureDetector.create(threshold)
    keypoints: list[cv2.KeyPoint] = []
    counts, corners = [], []
    for left, top, right, bottom in windows:
        found = detector.detect(image[top - rim : bottom + rim, left - rim : right + rim])
        if found:
            keypoints.extend(found)
            counts.append(len(found))
            corners.append((left - rim, top - rim))
    if not keypoints:
        return np.empty((0, 2), np.int64), np.empty(0)
    xy = np.asarray(cv2.KeyPoint.convert(keypoints)).astype(np.int64)
    xy += np.repeat(np.array(corners), counts, axis=0)
    return xy, np.fromiter(map(attrgetter("response"), keypoints), np.float64, len(keypoints))


def _occupied_cells(xy: IntArray, window: tuple[int, int, int, int], cell_px: int) -> BoolArray:
    """Which cells of the window hold a corner, (rows, columns)."""
    left, top, right, bottom = window
    occupied = np.zeros((-(-(bottom - top) // cell_px), -(-(right - left) // cell_px)), np.bool_)
    occupied[(xy[:, 1] - top) // cell_px, (xy[:, 0] - left) // cell_px] = True
    return occupied


def _empty_runs(
    occupied: BoolArray, window: tuple[int, int, int, int], cell_px: int
) -> list[tuple[int, int, int, int]]:
    """Join neighbouring empty cells of a row into windows: FAST costs more per call than per pixel."""
    left, top, right, bottom = window
    empty = np.zeros((occupied.shape[0], occupied.shape[1] + 2), np.bool_)
    np.logical_not(occupied, out=empty[:, 1:-1])
    rows, edges = np.nonzero(empty[:, 1:] != empty[:, :-1])  # of each run where it starts, then where it stops
    rows, starts, stops = rows[::2], edges[::2], edges[1::2]
    right_of, below = np.minimum(left + stops * cell_px, right), np.minimum(top + (rows + 1) * cell_px, bottom)
    sides = (left + starts * cell_px, top + rows * cell_px, right_of, below)
    return list(zip(*(side.tolist() for side in sides), strict=True))
