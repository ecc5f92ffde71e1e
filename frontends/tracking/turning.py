"""How a camera turns from image to image, and what that does to pixels that are read line by line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dualslam.core.arrays import median
from dualslam.core.camera.base import Camera
from dualslam.core.geometry import so3
from dualslam.core.noise_model import TINY
from dualslam.core.types import Features, FloatArray

MIN_PIXELS = 20
ROUNDS = 10
GATE_PX = 3.0
"""Residual at which a pixel's weight has fallen to a half: noise, and the parallax of a frame to the next."""
SETTLED = 1e-6
"""Change of a round, radians, that is none: a thousandth of a pixel at a focal length of 1,000."""


def turn_between(K: FloatArray, uv_a_px: FloatArray, uv_b_px: FloatArray) -> FloatArray | None:
    """Return the rotation vector (3,) of camera b in camera a's axes, ``log(R_a_b)``; None if too few pixels agree.

    Horn's rotation from rays, re-weighted (Cauchy): near points and wrong matches lose their say.

    - `K` (3, 3).
    - `uv_a_px`, `uv_b_px` (N, 2): matched rectified pixels.
    """
    if len(uv_a_px) < MIN_PIXELS:
        return None
    rays_a, rays_b = (unit_rays(K, uv) for uv in (uv_a_px, uv_b_px))
    R_a_b, gate = np.eye(3), np.inf
    for _ in range(ROUNDS):
        off_px = _off_px(K, rays_a, rays_b, R_a_b)
        # From the spread that is there down to that of noise: the first guess may be far off.
        narrowed = max(min(median(off_px), 0.5 * gate), GATE_PX)
        is_narrow, gate = narrowed == gate, narrowed
        weight = 1 / (1 + (off_px / gate) ** 2)
        U, _, Vt = np.linalg.svd((rays_a * weight) @ rays_b.T)
        before, R_a_b = R_a_b, U @ Vt
        if np.linalg.det(R_a_b) < 0:
            R_a_b = U * [1.0, 1.0, -1.0] @ Vt
        if is_narrow and np.abs(R_a_b - before).max() < SETTLED:
            break
    off_px = _off_px(K, rays_a, rays_b, R_a_b)
    agree = off_px < 3 * max(median(off_px), GATE_PX)
    return so3.log(R_a_b) if agree.sum() >= MIN_PIXELS else None


def _off_px(K: FloatArray, rays_a: FloatArray, rays_b: FloatArray, R_a_b: FloatArray) -> FloatArray:
    x, y, z = rays_a - R_a_b @ rays_b
    return np.asarray(K[0, 0] * np.sqrt(x * x + y * y + z * z))


def unit_rays(K: FloatArray, uv_px: FloatArray) -> FloatArray:
    """Return unit vectors (3, N) in the camera's frame, for pixels (N, 2)."""
    rays = np.ones((3, len(uv_px)))
    rays[:2] = ((uv_px - K[:2, 2]) / np.diag(K)[:2]).T
    return np.asarray(rays / np.sqrt((rays * rays).sum(axis=0)), np.float64)


def correct_shutter(
    features: Features, camera: Camera, turn_rad: FloatArray, read_px: FloatArray | None = None
) -> Features:
    """Move features to where they would be had all lines been read at the time of the middle one.

    - `features`: as found in an image that was read line by line (`read_at`).
    - `turn_rad` (3,): rotation vector by which the camera turns while an image is read, in its own axes.
    - `read_px` (N, 2): where the features were read, if `features` does not tell.
    """
    read_px = features.uv_px if read_px is None else read_px
    (uv_rect_px,) = at_middle(features.uv_rect_px, read_px, camera, turn_rad)
    # The found pixels move alike, so that the same features can be rectified again by a better camera.
    return replace(features, uv_px=features.uv_px + uv_rect_px - features.uv_rect_px, uv_rect_px=uv_rect_px)


def at_middle(uv_rect_px: FloatArray, read_px: FloatArray, camera: Camera, *turns_rad: FloatArray) -> list[FloatArray]:
    """Return rectified pixels (N, 2), read at pixels (N, 2), as they would be at the time of the middle line.

    For each of several turns (3,) of the camera while an image is read, in its own axes.
    """
    return [_to_middle(uv_rect_px, camera, turn_rad)(read_px) for turn_rad in turns_rad]


def read_at(read_px: FloatArray, size_px: tuple[int, int]) -> FloatArray:
    """Return when pixels (N, 2) are read, as shares of the readout from the middle line (N,).

    A sensor's lines run along its longer side. So an upright image is read column by column.
    """
    across = int(size_px[0] >= size_px[1])
    return np.asarray(read_px[:, across] / size_px[across] - 0.5)


def _to_middle(uv_rect_px: FloatArray, camera: Camera, turn_rad: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return what `at_middle` does with pixels (N, 2), by Rodrigues' formula: N matrices take thrice as long."""
    K = camera.K
    f, c = np.diag(K)[:2], K[:2, 2]
    rays = np.column_stack([(uv_rect_px - c) / f, np.ones(len(uv_rect_px))])
    angle_rad = float(np.linalg.norm(turn_rad))
    hat = so3.hat(turn_rad / max(angle_rad, TINY)).T
    across = rays @ hat
    inwards = across @ hat

    def moved(read_px: FloatArray) -> FloatArray:
        by = read_at(read_px, camera.size_px) * angle_rad
        # 1 - cos as a square: small turns keep their digits.
        turned = rays + np.sin(by)[:, None] * across + (2 * np.sin(0.5 * by) ** 2)[:, None] * inwards
        return np.asarray(f * turned[:, :2] / turned[:, 2:] + c, np.float64)

    return moved


def straighten(uv_px: FloatArray, camera: Camera, turn_rad: FloatArray) -> FloatArray:
    """Return where things that an image shows at pixels (N, 2) are in the features: as `correct_shutter` moves them."""
    uv_rect_px, _ = camera.rectify(uv_px)
    (moved_px,) = at_middle(uv_rect_px, uv_px, camera, turn_rad)
    return uv_px + moved_px - uv_rect_px


def find_as_read(uv_px: FloatArray, uv_rect_px: FloatArray, camera: Camera, turn_rad: FloatArray) -> FloatArray:
    """Return where an image shows what features have at pixels (N, 2), and rectified: inverse of `straighten`."""
    read_px, moved = uv_px, _to_middle(uv_rect_px, camera, -turn_rad)
    # Each was read in a line that is known once it is put back: a second time, it is.
    for _ in range(2):
        read_px = uv_px + moved(read_px) - uv_rect_px
    return read_px
