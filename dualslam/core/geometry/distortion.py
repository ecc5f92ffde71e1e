"""Lens distortion on the normalised image plane: radial polynomials with a safe inverse, and tangential terms."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from dualslam.core.types import FloatArray

N_ITERATIONS = 60
TOLERANCE = 1e-12
"""Of an inverted radius, relative to 1 + radius (normalised plane, so 1e-9 px at a focal length of 1000)."""


def radial(r: FloatArray, k: tuple[float, ...]) -> FloatArray:
    """Return ``r (1 + k[0] r^2 + k[1] r^4 + ...)``."""
    return r * _factor(r * r, k)


def radial_derivative(r: FloatArray, k: tuple[float, ...]) -> FloatArray:
    """Return the derivative of `radial` by r."""
    return _factor(r * r, _of_derivative(k))


def _of_derivative(k: tuple[float, ...]) -> tuple[float, ...]:
    return tuple((2 * i + 3) * c for i, c in enumerate(k))


@lru_cache(maxsize=64)  # of one lens it is asked for with each image
def radial_limit(k: tuple[float, ...]) -> float:
    """Return the radius up to which `radial` grows, so that it has an inverse: infinite for most lenses."""
    coefficients = [(2 * i + 3) * k[i] for i in reversed(range(len(k)))] + [1.0]
    roots = np.roots(coefficients)
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(np.sqrt(real.min())) if len(real) else float("inf")


def within_limit(xy: FloatArray, k: tuple[float, ...]) -> FloatArray:
    """Return undistorted points (N, 2), NaN from where on `radial` no longer grows: no image shows them."""
    limit = radial_limit(k)
    if not np.isfinite(limit):
        return xy
    return np.where((np.einsum("ij,ij->i", xy, xy) < limit**2)[:, None], xy, np.nan)


def invert_radial(r_distorted: FloatArray, k: tuple[float, ...], limit: float) -> FloatArray:
    """Return r with ``radial(r, k) == r_distorted`` on the growing branch, NaN where there is none below `limit`.

    Newton steps kept inside a bracket that halves whenever a step would leave it: it cannot diverge or change branch.
    """
    low = np.zeros_like(r_distorted)
    high = np.maximum(r_distorted, 1.0)
    if np.isfinite(limit):
        high = np.full_like(r_distorted, limit)
    reach = radial(high, k)
    for _ in range(0 if np.isfinite(limit) else N_ITERATIONS):
        short = reach < r_distorted
        if not short.any():
            break
        high = np.where(short, 2.0 * high, high)
        reach = radial(high, k)
    inside = reach >= r_distorted
    r, of_slope = np.minimum(r_distorted, high), _of_derivative(k)
    for _ in range(N_ITERATIONS):
        s = r * r
        error = r * _factor(s, k) - r_distorted
        np.copyto(high, r, where=error > 0)
        np.copyto(low, r, where=error < 0)
        slope = _factor(s, of_slope)
        rises = slope > 1e-12
        new = r - error / np.where(rises, slope, np.inf)
        odd = ~((new > low) & (new < high) & rises)
        if odd.any():
            new = np.where(odd, np.where(error == 0, r, 0.5 * (low + high)), new)
        moved, r = np.abs(new - r), new
        if not (inside & (moved > TOLERANCE * (1.0 + r))).any():
            break
    return np.where(inside, r, np.nan)


def distort_radtan(xy: FloatArray, k: tuple[float, ...], p1: float, p2: float) -> FloatArray:
    """Return distorted points (N, 2) of Brown's model with OpenCV's order of terms."""
    x, y = xy[:, 0], xy[:, 1]
    s = x * x + y * y
    return np.stack(_distorted(x, y, s, _factor(s, k), p1, p2), 1)


def radtan_jacobian(xy: FloatArray, k: tuple[float, ...], p1: float, p2: float) -> FloatArray:
    """Return d(distorted)/d(undistorted), (N, 2, 2), of `distort_radtan`."""
    x, y = xy[:, 0], xy[:, 1]
    s = x * x + y * y
    J = np.empty((len(xy), 2, 2))
    J[:, 0, 0], J[:, 0, 1], J[:, 1, 1] = _derivatives(x, y, _factor(s, k), _factor_slope(s, k), p1, p2)
    J[:, 1, 0] = J[:, 0, 1]
    return J


def _factor(s: FloatArray, k: tuple[float, ...]) -> FloatArray:
    """Return by how much points of squared radius s are moved outwards: ``1 + k[0] s + k[1] s^2 + ...``."""
    *lower, highest = k
    total = highest * s
    for c in reversed(lower):
        total += c
        total *= s
    total += 1.0
    return total


def _factor_slope(s: FloatArray, k: tuple[float, ...]) -> FloatArray:
    """Return the derivative of `_factor` by s."""
    slope = np.zeros_like(s)
    for i in reversed(range(len(k))):
        slope *= s
        slope += (i + 1) * k[i]
    return slope


def _distorted(
    x: FloatArray, y: FloatArray, s: FloatArray, factor: FloatArray, p1: float, p2: float
) -> tuple[FloatArray, FloatArray]:
    """Return the distorted x and y."""
    xd = x * factor + 2 * p1 * x * y + p2 * (s + 2 * x * x)
    yd = y * factor + p1 * (s + 2 * y * y) + 2 * p2 * x * y
    return xd, yd


def _derivatives(
    x: FloatArray, y: FloatArray, factor: FloatArray, slope: FloatArray, p1: float, p2: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return d(xd)/dx, d(xd)/dy, which is d(yd)/dx too, and d(yd)/dy."""
    xx = factor + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    xy = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    yy = factor + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return xx, xy, yy


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
    (x, y), (x_distorted, y_distorted) = xy.T.copy(), xy_distorted.T.copy()
    error = np.zeros_like(x)
    for _ in range(12):
        s = x * x + y * y
        factor = _factor(s, k)
        xd, yd = _distorted(x, y, s, factor, p1, p2)
        d_xx, d_xy, d_yy = _derivatives(x, y, factor, _factor_slope(s, k), p1, p2)
        error_x, error_y = xd - x_distorted, yd - y_distorted
        det = d_xx * d_yy - d_xy**2
        inverse = 1.0 / np.where(det > 1e-6, det, np.nan)
        step_x, step_y = (d_yy * error_x - d_xy * error_y) * inverse, (d_xx * error_y - d_xy * error_x) * inverse
        x, y = x - step_x, y - step_y
        error = np.maximum(np.abs(error_x), np.abs(error_y))
        if not (error > TOLERANCE).any():
            break
    good = (error < 1e-9) & (x * x + y * y <= limit * limit)
    return np.where(good[:, None], np.stack([x, y], 1), np.nan)
