"""How a camera turned between two neighbouring frames, from matched pixels alone."""

from __future__ import annotations

import numpy as np

from dualslam.core.arrays import median
from dualslam.core.geometry import so3
from dualslam.core.types import FloatArray

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
        if np.linalg.det(U) * np.linalg.det(Vt) < 0:
            U[:, 2] = -U[:, 2]
        before, R_a_b = R_a_b, U @ Vt
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
