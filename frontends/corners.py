"""Well-spread FAST corners on one pyramid level, and a sub-pixel step for them. Knows nothing of descriptors."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.types import BoolArray, FloatArray, IntArray
from frontends.matching import rank_in_group

FAST_RADIUS_PX = 3
"""FAST reads a circle of this radius, so it finds nothing nearer to the edge of what it is given."""


def detect_corners(
    image: NDArray[np.uint8], thresholds: Sequence[int], margin_px: int, cell_px: int
) -> tuple[IntArray, FloatArray]:
    """FAST corners of one pyramid level: the first threshold everywhere, lower ones only in cells still empty.

    Parameters
    ----------
    image : (H, W) uint8
    thresholds : sequence of int
        Grey-level contrasts, descending.
    margin_px : int
        Width of the rim without corners, >= 3.
    cell_px : int
        Side of the square cells in which emptiness is judged.

    Returns
    -------
    xy : (N, 2) int64
        Pixel (column, row).
    response : (N,) float64
        FAST score: the largest threshold at which the corner would still be one.
    """
    height, width = image.shape
    if min(height, width) <= 2 * margin_px:
        return np.empty((0, 2), np.int64), np.empty(0)
    window = (margin_px, margin_px, width - margin_px, height - margin_px)
    xy, response = _fast(image, thresholds[0], window)
    for threshold in thresholds[1:]:
        windows = _empty_runs(_occupied_cells(xy, window, cell_px), window, cell_px)
        found = [_fast(image, threshold, each) for each in windows]
        xy = np.concatenate([xy, *(each[0] for each in found)])
        response = np.concatenate([response, *(each[1] for each in found)])
    return xy, response


def select_spread(xy: IntArray, response: FloatArray, n_wanted: int) -> IntArray:
    """Choose corners that are strong and cover the level: the best of each cell first, then the second best, ...

    The cells are as many as the corners wanted, over the corners' bounding box.

    Returns
    -------
    (min(N, n_wanted),) int64
        Rows, ascending.
    """
    if len(xy) <= n_wanted:
        return np.arange(len(xy))
    if n_wanted == 0:
        return np.empty(0, np.int64)
    low = xy.min(axis=0)
    extent = xy.max(axis=0) - low + 1
    cell_px = max(1.0, float(np.sqrt(extent[0] * extent[1] / n_wanted)))
    column, row = ((xy - low) / cell_px).astype(np.int64).T
    cell = row * int(extent[0] / cell_px + 1) + column
    # Ties go to the earlier corner (lexsort is stable), so the choice depends on nothing but the image.
    order = np.lexsort((-response, rank_in_group(cell, -response)))
    return np.sort(order[:n_wanted])


def share_out(n_available: Sequence[int], weights: FloatArray, n_wanted: int) -> list[int]:
    """Divide `n_wanted` among levels by weight; what a poor level cannot fill goes to the others, finest first.

    Parameters
    ----------
    n_available : sequence of int
        Corners of each level.
    weights : (L,) float64
        Positive; only their ratios count.
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


def refine_corners(patches: NDArray[np.uint8]) -> FloatArray:
    """Sub-pixel offset of the corner at the centre of each patch, by one step of the Foerstner operator.

    Foerstner & Guelch 1987: the point nearest to all the edge lines of its window, each weighted by its gradient.

    Parameters
    ----------
    patches : (N, S, S) uint8
        S odd and >= 11.

    Returns
    -------
    (N, 2) float64
        Offset (du, dv) in pixels of the level; zero where it would leave the pixel's neighbourhood (no single corner).
    """
    weight, reach = _window_weights()
    centre = patches.shape[1] // 2
    part = slice(centre - reach - 1, centre + reach + 2)
    grey = patches[:, part, part].astype(np.float32)
    gx = (grey[:, 1:-1, 2:] - grey[:, 1:-1, :-2]).reshape(len(grey), weight.shape[0])
    gy = (grey[:, 2:, 1:-1] - grey[:, :-2, 1:-1]).reshape(len(grey), weight.shape[0])
    # Columns of each product: sum of w g g, of w g g x, of w g g y.
    xx, xy, yy = ((gx * gx) @ weight, (gx * gy) @ weight, (gy * gy) @ weight)
    rhs_x, rhs_y = xx[:, 1] + xy[:, 2], xy[:, 1] + yy[:, 2]
    determinant = xx[:, 0] * yy[:, 0] - xy[:, 0] ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = np.stack([yy[:, 0] * rhs_x - xy[:, 0] * rhs_y, xx[:, 0] * rhs_y - xy[:, 0] * rhs_x], axis=1)
        offset = (offset / determinant[:, None]).astype(np.float64)
        trusted = (np.abs(offset) <= 1.0).all(axis=1)
    return np.where(trusted[:, None], offset, 0.0)


@lru_cache(maxsize=1)
def _window_weights(reach: int = 3, sigma_px: float = 2.0) -> tuple[NDArray[np.float32], int]:
    """Gaussian weights w, w x, w y of a (2 reach + 1)^2 window as ((2 reach + 1)^2, 3) columns."""
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(np.float32)
    w = np.exp(-(u**2 + v**2) / (2 * sigma_px**2))
    return np.stack([w, w * u, w * v], axis=-1).reshape(-1, 3), reach


def _fast(image: NDArray[np.uint8], threshold: int, window: tuple[int, int, int, int]) -> tuple[IntArray, FloatArray]:
    """FAST corners inside `window` (left, top, right, bottom, the last two exclusive), in pixels of the image."""
    left, top, right, bottom = window
    rim = FAST_RADIUS_PX
    view = image[top - rim : bottom + rim, left - rim : right + rim]
    keypoints = cv2.FastFeatureDetector.create(threshold).detect(view)
    if not keypoints:
        return np.empty((0, 2), np.int64), np.empty(0)
    xy = cv2.KeyPoint.convert(keypoints).astype(np.int64) + (left - rim, top - rim)
    return xy, np.array([keypoint.response for keypoint in keypoints])


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
    edges = np.diff(np.pad(~occupied, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    rows, starts = np.nonzero(edges == 1)
    _, stops = np.nonzero(edges == -1)
    return [
        (
            left + start * cell_px,
            top + row * cell_px,
            min(left + stop * cell_px, right),
            min(top + (row + 1) * cell_px, bottom),
        )
        for row, start, stop in zip(rows.tolist(), starts.tolist(), stops.tolist(), strict=True)
    ]
