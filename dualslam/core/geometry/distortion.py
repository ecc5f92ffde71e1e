"""Lens distortion on the normalised image plane: radial polynomials with a safe inverse, and tangential terms."""

from __future__ import annotations

import numpy as np

from dualslam.core.types import FloatArray

N_ITERATIONS = 60
TOLERANCE = 1e-12
"""Of an inverted radius, relative to 1 + radius (normalised plane, so 1e-9 px at a focal length of 1000)."""


def radial(r: FloatArray, k: tuple[float, ...]) -> FloatArray:
    """Return ``r (1 + k[0] r^2 + k[1] r^4 + ...)``."""
    s = r * r
    total = np.zeros_like(s)
    for c in reversed(k):
        total = (total + c) * s
    return r * (1.0 + total)


def radial_derivative(r: FloatArray, k: tuple[float, ...]) -> FloatArray:
    """Return the derivative of `radial` by r."""
    s = r * r
    total = np.zeros_like(s)
    for i in reversed(range(len(k))):
        total = (total + (2 * i + 3) * k[i]) * s
    return 1.0 + total


def radial_limit(k: tuple[float, ...]) -> float:
    """Return the radius up to which `radial` grows, so that it has an inverse: infinite for most lenses."""
    coefficients = [(2 * i + 3) * k[i] for i in reversed(range(len(k)))] + [1.0]
    roots = np.roots(coefficients)
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(np.sqrt(real.min())) if len(real) else float("inf")


def invert_radial(r_distorted: FloatArray, k: tuple[float, ...], limit: float) -> FloatArray:
    """Return r with ``radial(r, k) == r_distorted`` on the growing branch, NaN where there is none below `limit`.

    Newton steps kept inside a bracket that halves whenever a step would leave it: it cannot diverge or change branch.
    """
    low = np.zeros_like(r_distorted)
    high = np.maximum(r_distorted, 1.0)
    if np.isfinite(limit):
        high = np.full_like(r_distorted, limit)
    else:
        for _ in range(N_ITERATIONS):
            short = radial(high, k) < r_distorted
            if not short.any():
                break
            high = np.where(short, 2.0 * high, high)
    inside = radial(high, k) >= r_distorted
    r = np.minimum(r_distorted, high)
    for _ in range(N_ITERATIONS):
        error = radial(r, k) - r_distorted
        high, low = np.where(error > 0, r, high), np.where(error < 0, r, low)
        slope = radial_derivative(r, k)
        new = r - error / np.where(slope > 1e-12, slope, np.inf)
        new = np.where((new > low) & (new < high) & (slope > 1e-12), new, np.where(error == 0, r, 0.5 * (low + high)))
        moved, r = np.abs(new - r), new
        if not (inside & (moved > TOLERANCE * (1.0 + r))).any():
            break
    return np.where(inside, r, np.nan)


def distort_radtan(xy: FloatArray, k: tuple[float, ...], p1: float, p2: float) -> FloatArray:
    """Return distorted points (N, 2) of Brown's model with OpenCV's order of terms."""
    x, y = xy[:, 0], xy[:, 1]
    s = x * x + y * y
    total = np.zeros_like(s)
    for c in reversed(k):
        total = (total + c) * s
    factor = 1.0 + total
    xd = x * factor + 2 * p1 * x * y + p2 * (s + 2 * x * x)
    yd = y * factor + p1 * (s + 2 * y * y) + 2 * p2 * x * y
    return np.stack([xd, yd], 1)


def radtan_jacobian(xy: FloatArray, k: tuple[float, ...], p1: float, p2: float) -> FloatArray:
    """Return d(distorted)/d(undistorted), (N, 2, 2), of `distort_radtan`."""
    x, y = xy[:, 0], xy[:, 1]
    s = x * x + y * y
    total, slope = np.zeros_like(s), np.zeros_like(s)
    for i in reversed(range(len(k))):
        total = (total + k[i]) * s
        slope = slope * s + (i + 1) * k[i]  # d(factor) / ds
    factor = 1.0 + total
    J = np.empty((len(xy), 2, 2))
    J[:, 0, 0] = factor + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    J[:, 0, 1] = J[:, 1, 0] = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    J[:, 1, 1] = factor + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return J


def undistort_division(xy_distorted: FloatArray, k: float) -> FloatArray:
    """Return where points (N, 2) would be without a lens of the division model, for any k r^2 above -1."""
    r2 = (xy_distorted * xy_distorted).sum(1)
    return np.asarray(xy_distorted / (1.0 + k * r2)[:, None], np.float64)


def division_area_ratio(xy_distorted: FloatArray, k: float) -> FloatArray:
    """Return the determinant (N,) of d(distorted)/d(undistorted) of the division model at distorted points (N, 2)."""
    kr2 = k * (xy_distorted * xy_distorted).sum(1)
    return np.asarray((1.0 + kr2) ** 3 / (1.0 - kr2), np.float64)


def undistort_radtan(xy_distorted: FloatArray, k: tuple[float, ...], p1: float, p2: float) -> FloatArray:
    """Return undistorted points (N, 2), NaN where the model has no inverse: radial first, then Newton in both axes."""
    r_distorted = np.sqrt((xy_distorted**2).sum(1))
    limit = radial_limit(k)
    r = invert_radial(r_distorted, k, limit)
    at_edge = np.isnan(r) & np.isfinite(r_distorted)  # the tangential terms may still bring it in
    r = np.where(at_edge, 0.99 * limit if np.isfinite(limit) else 0.0, r)
    xy = xy_distorted * (r / np.where(r_distorted > 0, r_distorted, 1.0))[:, None]
    if p1 == 0.0 and p2 == 0.0:
        return np.where(at_edge[:, None], np.nan, xy)
    error = np.zeros_like(xy)
    for _ in range(12):
        error = distort_radtan(xy, k, p1, p2) - xy_distorted
        J = radtan_jacobian(xy, k, p1, p2)
        det = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] ** 2
        inverse = 1.0 / np.where(det > 1e-6, det, np.nan)
        step_x = (J[:, 1, 1] * error[:, 0] - J[:, 0, 1] * error[:, 1]) * inverse
        step_y = (J[:, 0, 0] * error[:, 1] - J[:, 0, 1] * error[:, 0]) * inverse
        xy = xy - np.stack([step_x, step_y], 1)
        if not (np.abs(error) > TOLERANCE).any():
            break
    good = (np.abs(error).max(1) < 1e-9) & ((xy * xy).sum(1) <= limit * limit)
    return np.where(good[:, None], xy, np.nan)
