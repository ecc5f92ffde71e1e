"""Chi-square: its quantiles by degrees of freedom, one table, from SciPy; and what is held against them."""

from __future__ import annotations

import numpy as np
from scipy.special import gammaincinv

from dualslam.core.types import FloatArray, IntArray

MAX_DOF = 7


def chi2_quantile(n_dof: int, confidence: float) -> float:
    """Return what a chi-square with `n_dof` degrees of freedom does not exceed with this probability.

    It is rounded to three decimals, as tables print it: gates do not depend on the last bit of a library.
    """
    return round(2.0 * float(gammaincinv(0.5 * n_dof, confidence)), 3)


def _row(confidence: float) -> tuple[float, ...]:
    return (0.0, *(chi2_quantile(n, confidence) for n in range(1, MAX_DOF + 1)))


MEDIAN_CHI2, CHI2_90, CHI2_95, CHI2_99, CHI2_999, CHI2_9999 = map(_row, (0.5, 0.9, 0.95, 0.99, 0.999, 0.9999))
"""By degrees of freedom: `CHI2_95[2]` is the squared whitened distance to a point that 95 % of true matches keep."""


def squared_distances(residuals: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return (E,) squared residuals (E, N), each in its own covariance (E, N, N)."""
    return np.asarray(np.einsum("ei,ei->e", residuals, np.linalg.solve(covariances, residuals[..., None])[..., 0]))


def variance_by_median(chi2: FloatArray, n_views: IntArray) -> float:
    """Return the variance of whitened pixel residuals, by their median: 1 where the pixels' sigmas are right.

    - `chi2` (R,): squared whitened residuals (2 degrees of freedom) of observations.
    - `n_views` (R,): views that each one's landmark has, at least 2; it takes 3 of their ``2 n`` numbers.
    """
    return float(np.median(chi2 / (1 - 1.5 / n_views))) / MEDIAN_CHI2[2]


def huber_weights(chi2: FloatArray, gate: float) -> FloatArray:
    """Return Huber's weights of squared whitened residuals: 1 up to `gate`, the threshold's square, less beyond."""
    return np.asarray(np.sqrt(gate / np.maximum(chi2, gate)), np.float64)
