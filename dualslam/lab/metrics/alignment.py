"""Umeyama's alignment for scoring, which has an answer for any input."""

from __future__ import annotations

import numpy as np

from dualslam.core.types import FloatArray


def align_points(p: FloatArray, q: FloatArray, *, with_scale: bool = True) -> tuple[float, FloatArray, FloatArray]:
    """Return s, R, t that minimise the sum of ``|q - (s R p + t)|^2`` (Umeyama 1991), p and q (N, 3).

    Unlike the alignment that links maps, this one has an answer for any input: a trajectory that never moved, or moved
    on a line only, must be scored too.
    """
    mean_p, mean_q = p.mean(axis=0), q.mean(axis=0)
    a, b = p - mean_p, q - mean_q
    U, D, Vt = np.linalg.svd(b.T @ a / len(p))  # Eq. (38)
    S = np.ones(3)
    if np.linalg.det(U) * np.linalg.det(Vt) < 0:
        S[-1] = -1.0  # Eq. (39)
    R = np.asarray(U @ np.diag(S) @ Vt, np.float64)  # Eq. (40)
    variance = (a * a).sum() / len(p)
    s = float((D * S).sum() / max(variance, 1e-300)) if with_scale else 1.0  # Eq. (42)
    return s, R, np.asarray(mean_q - s * R @ mean_p, np.float64)  # Eq. (41)


def distances_when_aligned(p: FloatArray, q: FloatArray) -> FloatArray:
    """Return how far each of p is from its partner of q, both (N, 3), once all of p are aligned by a similarity."""
    s, R, t = align_points(p, q)
    return np.asarray(np.linalg.norm(q - (s * p @ R.T + t), axis=1), np.float64)
