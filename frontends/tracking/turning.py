"""How a camera turned between two neighbouring frames, from matched pixels alone."""

from __future__ import annotations

import numpy as np

from dualslam.core.geometry import so3
from dualslam.core.types import FloatArray

MIN_PIXELS = 20
ROUNDS = 10
GATE_PX = 3.0
"""Residual at which a pixel's weight has fallen to a half: noise, and the parallax of a frame to the next."""


def turn_between(K: FloatArray, uv_a_px: FloatArray, uv_b_px: FloatArray) -> FloatArray | None:
    """Return the rotation vector (3,) of camera b in camera a's axes, ``log(R_a_b)``; None if too few pixels agree.

    Horn's rotation from rays, re-weighted (Cauchy): near points and wrong matches lose their say.

    Parameters
    ----------
    K : (3, 3)
    uv_a_px, uv_b_px : (N, 2)
        Matched rectified pixels.
    """
    if len(uv_a_px) < MIN_PIXELS:
        return None
    rays_a, rays_b = (_rays(K, uv) for uv in (uv_a_px, uv_b_px))
    R_a_b, gate = np.eye(3), np.inf
    for _ in range(ROUNDS):
        off_px = K[0, 0] * np.linalg.norm(rays_a - rays_b @ R_a_b.T, axis=1)
        # From the spread that is there down to that of noise: the first guess may be far off.
        gate = max(min(float(np.median(off_px)), 0.5 * gate), GATE_PX)
        weight = 1 / (1 + (off_px / gate) ** 2)
        U, _, Vt = np.linalg.svd((rays_a * weight[:, None]).T @ rays_b)
        R_a_b = U @ np.diag([1, 1, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt
    off_px = K[0, 0] * np.linalg.norm(rays_a - rays_b @ R_a_b.T, axis=1)
    agree = off_px < 3 * max(float(np.median(off_px)), GATE_PX)
    return so3.log(R_a_b) if agree.sum() >= MIN_PIXELS else None


def _rays(K: FloatArray, uv_px: FloatArray) -> FloatArray:
    x = (uv_px - K[:2, 2]) / np.diag(K)[:2]
    rays = np.concatenate([x, np.ones((len(x), 1))], axis=1)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True), np.float64)
