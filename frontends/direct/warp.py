"""Image patches warped between two views by pose and depth, and how well they agree.

A patch is a square grid of grey values about a point. Its plane is taken parallel to the image of its reference view.
The warp is affine within a patch. All patches of a view are warped at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.camera.base import Camera, plane
from dualslam.core.geometry import se3
from dualslam.core.noise_model import TINY
from dualslam.core.types import BoolArray, FloatArray, IntArray

Pyramid = list[NDArray[np.float32]]

MAX_LEVELS = 4
HALF = 4
"""Half the side of a patch, in its own pixels: 9 x 9 of them."""
AGREES = 0.7
"""Correlation of a patch that is where the pose puts it: noise and blur leave this much; another place seldom has."""
MIN_CONTRAST = 4.0
"""Standard deviation of greys: sensors have a noise of 1 to 3, and blank images have that alone."""
MIN_SIDE_PX = 48
"""An image with a shorter side is not halved again."""
REMAP_ROWS = 30000
"""`cv2.remap` takes no more than 32767."""


@dataclass(frozen=True, slots=True, eq=False)
class Warp:
    """Where N points of view a are in view b."""

    uv_rect_a_px: FloatArray  # (N, 2): rectified pixels of the points in a
    # Pixels in b as its lens shows them, and rectified; NaN where b does not show a point.
    uv_px: FloatArray  # (N, 2)
    uv_rect_px: FloatArray  # (N, 2)
    J_b_a: FloatArray  # (N, 2, 2): derivative of a pixel in b by its pixel in a

    @property
    def zoom(self) -> FloatArray:
        """(N,) how much larger things are in b; NaN where they are not in it."""
        J = self.J_b_a
        return np.asarray(np.sqrt(np.abs(J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0])))


def build_pyramid(image: NDArray[np.uint8], max_levels: int = MAX_LEVELS) -> Pyramid:
    """Return the image and its halves."""
    levels = [image.astype(np.float32)]
    while len(levels) < max_levels and min(levels[-1].shape) >= MIN_SIDE_PX:
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), np.float32))
    return levels


def warp_points(camera: Camera, uv_px: FloatArray, depth: FloatArray, T_b_a: FloatArray) -> Warp:
    """Warp pixels (N, 2) of view a, at depths (N,), into view b of the same camera; `T_b_a` (4, 4), or one for each."""
    n = len(uv_px)
    # One call for all: taking a lens out costs more by the call than by the pixel.
    rays = camera.unproject((uv_px + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])[:, None]).reshape(-1, 2))
    p = rays * (np.tile(depth, 3) / rays[:, 2])[:, None]
    R, t = se3.rotation(T_b_a[...]), se3.translation(T_b_a[...])
    moved = p @ R.T if R.ndim == 2 else np.einsum("nij,snj->sni", R, p.reshape(3, n, 3))
    p_b = (moved + t).reshape(-1, 3)
    here, right, down = camera.project(p_b).reshape(3, n, 2)
    rect, rect_b = (plane(x[:n]) * np.diag(camera.K)[:2] + camera.K[:2, 2] for x in (rays, p_b))
    return Warp(rect, here, rect_b, np.stack([right - here, down - here], axis=2))


def project_with_jacobians(camera: Camera, p_cam: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the pixels (N, 2) of points (N, 3) as the lens shows them, and their derivatives (N, 2, 3) by the points.

    NaN where the camera does not show a point.
    """
    n = len(p_cam)
    step = 1e-3 * np.linalg.norm(p_cam, axis=1, keepdims=True)
    moved = np.concatenate([p_cam, p_cam + step * [1.0, 0.0, 0.0], p_cam + step * [0.0, 1.0, 0.0]])
    here, right, down = camera.project(moved).reshape(3, n, 2)
    by_x, by_y = (right - here) / step, (down - here) / step
    # A pixel depends on the ray alone: it does not change along it.
    z = np.where(np.abs(p_cam[:, 2:]) > TINY, p_cam[:, 2:], np.nan)
    by_z = -(p_cam[:, :1] * by_x + p_cam[:, 1:2] * by_y) / z
    return here, np.stack([by_x, by_y, by_z], axis=2)


def inside(uv_px: FloatArray, axes: FloatArray, half: int, size_px: tuple[int, int]) -> BoolArray:
    """Return which patches (N,), as `sample` takes them, are wholly in the image; NaN is not."""
    reach = half * np.abs(axes).sum(axis=2)
    return np.asarray(((uv_px > reach) & (uv_px < np.array(size_px) - 1 - reach)).all(axis=1), np.bool_)


def sample(levels: Pyramid, uv_px: FloatArray, axes: FloatArray, half: int) -> NDArray[np.float32]:
    """Return patches (N, S, S), S = 2 half + 1, about places (N, 2).

    - `levels` (list of (H, W)), `uv_px` (N, 2).
    - `axes` (N, 2, 2): columns: steps in the image from one pixel of the patch to its right and lower neighbour.
    """
    return Sampler([levels], np.zeros(len(uv_px), np.int64), axes, half)(uv_px)


class Sampler:
    """Takes patches as `sample` does, each of its own image, at places that may change.

    - `image_of` (N,): rows of `images`.
    - `axes` (N, 2, 2), `half`: as for `sample`.
    """

    def __init__(self, images: Sequence[Pyramid], image_of: IntArray, axes: FloatArray, half: int) -> None:
        step = np.sqrt(np.abs(np.linalg.det(axes)))
        highest = np.array([len(levels) - 1 for levels in images])[image_of]
        level = np.clip(np.rint(np.log2(np.maximum(step, 1e-6))), 0, highest).astype(np.int64)
        source = MAX_LEVELS * image_of + level
        self._order = np.argsort(source, kind="stable")
        # The middle of a level's first pixel is the middle of the image's.
        self._shrunk = 2.0 ** level[self._order, None]
        right, down = (axes[self._order] / self._shrunk[..., None]).transpose(2, 1, 0)[..., None, None]
        self._side, grid = 2 * half + 1, np.arange(-half, half + 1, dtype=np.float64)
        self._right, self._down = right * grid, down * grid[:, None]
        runs = _runs(source[self._order], REMAP_ROWS // self._side)
        from_image = (divmod(int(source[self._order[begin]]), MAX_LEVELS) for begin, _ in runs)
        self._runs = [(images[of][n], *run) for (of, n), run in zip(from_image, runs, strict=True)]

    def __call__(self, uv_px: FloatArray) -> NDArray[np.float32]:
        """Return patches (N, S, S) about places (N, 2)."""
        n, side = len(self._order), self._side
        at = np.empty((2, n, side, side), np.float32)
        np.add((uv_px[self._order] / self._shrunk).T[..., None, None] + self._right, self._down, out=at)
        sampled, patches = np.empty((n * side, side), np.float32), np.empty((n, side, side), np.float32)
        u, v = at.reshape(2, -1, side)
        for image, begin, end in self._runs:
            here = slice(begin * side, end * side)
            cv2.remap(image, u[here], v[here], cv2.INTER_LINEAR, sampled[here], cv2.BORDER_REPLICATE)
        patches[self._order] = sampled.reshape(n, side, side)
        return patches


def _runs(values: IntArray, longest: int) -> list[tuple[int, int]]:
    """Return where each run of equal values begins and ends, longer ones in parts."""
    bounds = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(values)]
    return [(k, min(k + longest, end)) for begin, end in pairwise(bounds) for k in range(begin, end, longest)]


def correlate(a: NDArray[np.generic], b: NDArray[np.generic]) -> FloatArray:
    """Return the zero-mean normalised cross-correlation (N,) of patches (N, S, S); 0 where one of them is flat."""
    x, y = (each.reshape(len(each), math.prod(each.shape[1:])).astype(np.float64) for each in (a, b))
    x, y = x - x.mean(axis=1, keepdims=True), y - y.mean(axis=1, keepdims=True)
    norm = np.sqrt((x * x).sum(axis=1) * (y * y).sum(axis=1))
    return np.asarray((x * y).sum(axis=1) / np.maximum(norm, TINY), np.float64)
