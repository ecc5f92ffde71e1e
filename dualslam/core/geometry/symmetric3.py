"""Batches of symmetric 3x3 matrices as six planes (xx, xy, xz, yy, yz, zz): closed forms, faster than LAPACK."""

from __future__ import annotations

import numpy as np

from dualslam.core.types import FloatArray

ROWS = np.array([0, 0, 0, 1, 1, 2])
COLUMNS = np.array([0, 1, 2, 1, 2, 2])
_FULL = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])


def planes(M: FloatArray) -> FloatArray:
    """Return the six planes (6, ...) of symmetric matrices (..., 3, 3)."""
    return np.ascontiguousarray(np.moveaxis(M[..., ROWS, COLUMNS], -1, 0))


def matrices(m: FloatArray) -> FloatArray:
    """Return matrices (..., 3, 3) of six planes (6, ...)."""
    full: FloatArray = np.moveaxis(m[_FULL], 0, -1)
    return full.reshape(*full.shape[:-1], 3, 3)


def adjugate(m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (adjugate (6, ...), determinant (...)): the inverse is their quotient."""
    xx, xy, xz, yy, yz, zz = m
    adj = np.empty_like(m)
    adj[0] = yy * zz - yz * yz
    adj[1] = xz * yz - xy * zz
    adj[2] = xy * yz - xz * yy
    adj[3] = xx * zz - xz * xz
    adj[4] = xy * xz - xx * yz
    adj[5] = xx * yy - xy * xy
    return adj, xx * adj[0] + xy * adj[1] + xz * adj[2]


def multiply(m: FloatArray, v: FloatArray) -> FloatArray:
    """Return M v for six planes (6, ...) and vectors (3, ...)."""
    x, y, z = v
    return np.stack([m[0] * x + m[1] * y + m[2] * z, m[1] * x + m[3] * y + m[4] * z, m[2] * x + m[4] * y + m[5] * z])


def quadratic_inverse(m: FloatArray, v: FloatArray) -> FloatArray:
    """Return ``v' M^-1 v``, the squared Mahalanobis distance of v (3, ...) under covariances M (6, ...)."""
    adj, det = adjugate(m)
    x, y, z = v
    form = adj[0] * x * x + adj[3] * y * y + adj[5] * z * z + 2 * (adj[1] * x * y + adj[2] * x * z + adj[4] * y * z)
    return np.asarray(form / det, np.float64)
