"""Quantiles of chi-square by degrees of freedom: one table, from SciPy."""

from __future__ import annotations

from scipy.special import gammaincinv

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
