"""Rotation matrices and unit quaternions (x, y, z, w), many at once, as trajectory files need them."""

from __future__ import annotations

import numpy as np

from dualslam.core.types import FloatArray


def matrix_from_quat_xyzw(quat_xyzw: FloatArray) -> FloatArray:
    """Return (N, 3, 3) rotations of (N, 4) quaternions, which need not be of unit length."""
    x, y, z, w = (quat_xyzw / np.linalg.norm(quat_xyzw, axis=1, keepdims=True)).T
    R = np.empty((len(quat_xyzw), 3, 3))
    R[:, 0, 0], R[:, 0, 1], R[:, 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    R[:, 1, 0], R[:, 1, 1], R[:, 1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    R[:, 2, 0], R[:, 2, 1], R[:, 2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    return R


def quat_xyzw_from_matrix(R: FloatArray) -> FloatArray:
    """Return (N, 4) unit quaternions with w >= 0 of (N, 3, 3) rotations.

    Each comes from the largest of its four components, which is never near zero (Shepperd 1978).
    """
    n = len(R)
    diagonal = np.stack([R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]], axis=1)
    trace = diagonal.sum(axis=1)
    # Four times the outer product q q^T, in the order x, y, z, w.
    outer = np.empty((n, 4, 4))
    for i in range(3):
        outer[:, i, i] = 1 + 2 * diagonal[:, i] - trace
        j, k = (i + 1) % 3, (i + 2) % 3
        outer[:, i, j] = outer[:, j, i] = R[:, j, i] + R[:, i, j]
        outer[:, i, 3] = outer[:, 3, i] = R[:, k, j] - R[:, j, k]
    outer[:, 3, 3] = 1 + trace
    largest = np.argmax(np.diagonal(outer, axis1=1, axis2=2), axis=1)
    q = outer[np.arange(n), largest]
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    return np.where(q[:, 3:] < 0, -q, q)
