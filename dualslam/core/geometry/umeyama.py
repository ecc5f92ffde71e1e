"""Alignment of two sets of corresponding 3D points by a similarity, in closed form.

Source: S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991. The
robust estimate with covariances is in `dualslam.core.geometry.alignment`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualslam.core.geometry import sim3
from dualslam.core.types import BoolArray, Failure, FailureReason, FloatArray

MIN_SPREAD_RATIO = 1e-4
"""Second over first singular value of centred points, below which they count as collinear. The rotation about the line
has the points' relative error over this ratio as its own error: points known to 6 digits (float32, text files) would
leave it uncertain to about a degree."""
MIN_RELATIVE_EXTENT = 1e-9
"""First singular value over the largest coordinate, below which points coincide: what is left is rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """A least-squares similarity between two point sets."""

    S_dst_src: FloatArray  # (4, 4): x -> s R x + t; a rigid pose where the scale was held at 1
    rmse: float  # root of the (weighted) mean squared residual, in the unit of dst


def umeyama(
    src: FloatArray, dst: FloatArray, weights: FloatArray | None = None, with_scale: bool = True
) -> Alignment | Failure:
    """Return the similarity (or pose) that takes `src` nearest to `dst` in the least-squares sense.

    - `src`, `dst` (N, 3): corresponding points.
    - `weights` (N,): non-negative weights.
    - `with_scale`: false holds the scale at 1.

    Returns Alignment or Failure: `DEGENERATE` for fewer than three points, or coincident or collinear ones in either
    set; `SCALE` if s <= 0.
    """
    w = np.ones(len(src)) if weights is None else np.asarray(weights, np.float64)
    n_used = int(np.count_nonzero(w))
    if n_used < 3:
        return Failure(FailureReason.DEGENERATE, f"{n_used} points, 3 needed", {"n": float(n_used)})
    w = w / w.sum()
    mean_src, mean_dst = w @ src, w @ dst
    a, b = src - mean_src, dst - mean_dst
    root = np.sqrt(w)[:, None]
    for name, centred, points in (("src", a, src), ("dst", b, dst)):
        spread = np.linalg.svd(root * centred, compute_uv=False)
        if not spread[0] > MIN_RELATIVE_EXTENT * np.abs(points[w > 0]).max():
            return Failure(FailureReason.DEGENERATE, f"the {name} points coincide", {"n": float(n_used)})
        if not spread[1] > MIN_SPREAD_RATIO * spread[0]:
            numbers = {"n": float(n_used), "spread_ratio": float(spread[1] / spread[0])}
            return Failure(FailureReason.DEGENERATE, f"the {name} points are collinear", numbers)
    R, trace = _rotation((b * w[:, None]).T @ a)
    variance = float((w @ (a * a)).sum())
    s = float(trace) / variance if with_scale else 1.0  # Eq. (42)
    if not s > 0.0:
        return Failure(FailureReason.SCALE, f"scale {s:.3g} is not positive", {"scale": s})
    t = mean_dst - s * (R @ mean_src)  # Eq. (41)
    residual = b - s * (a @ R.T)
    return Alignment(sim3.from_parts(s, R, t), float(np.sqrt(w @ (residual * residual).sum(1))))


def _rotation(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (R, trace(D S)) of cross-covariances (..., 3, 3), dst times src'. Umeyama, eqs. (39), (40), (43)."""
    U, D, Vt = np.linalg.svd(covariance)
    sign = np.where(np.linalg.det(U) * np.linalg.det(Vt) < 0, -1.0, 1.0)
    U[..., :, 2] *= sign[..., None]
    D[..., 2] *= sign
    return np.asarray(U @ Vt, np.float64), np.asarray(D.sum(-1), np.float64)


def umeyama_batch(src: FloatArray, dst: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Align many triplets of points at once: the minimal solver of a RANSAC.

    `src`, `dst` (B, 3, 3): B sets of three corresponding points, one point a row. (Any number of points a set works.)

    Returns ``S_dst_src`` (B, 4, 4), and which of them are valid (B,): none of a triplet that is coincident or collinear
    on either side.
    """
    mean_src, mean_dst = src.mean(1), dst.mean(1)
    a, b = src - mean_src[:, None], dst - mean_dst[:, None]
    valid = _spread_enough(a, src) & _spread_enough(b, dst)
    R, trace = _rotation(b.swapaxes(1, 2) @ a)
    variance = (a * a).sum((1, 2))
    s = trace / np.where(variance > 0, variance, 1.0)
    valid &= s > 0
    t = mean_dst - s[:, None] * (R @ mean_src[..., None])[..., 0]
    return sim3.from_parts(s, R, t), valid


def _spread_enough(centred: FloatArray, points: FloatArray) -> BoolArray:
    """Return which of the sets (B, M, 3) span a plane. The criterion of `umeyama`, from invariants of the scatter."""
    scatter = centred.swapaxes(1, 2) @ centred
    trace = scatter[:, 0, 0] + scatter[:, 1, 1] + scatter[:, 2, 2]
    # Sum of the principal minors = sum of products of eigenvalues; about (spread ratio)^2 times trace^2 near a line.
    minors = 0.5 * (trace**2 - (scatter * scatter).sum((1, 2)))
    extent = MIN_RELATIVE_EXTENT * np.abs(points).max((1, 2))
    return np.asarray((minors > (MIN_SPREAD_RATIO * trace) ** 2) & (trace > extent**2), np.bool_)
