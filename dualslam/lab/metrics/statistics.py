"""How sure a count is: intervals for rates, and for how far one rate lies below another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import binomtest

LEVEL = 0.95
RESAMPLES = 10_000
MIN_CLUSTERS = 5
"""With fewer clusters that failed at all, resamples have too few different outcomes (35 of four clusters, 126 of five)
to tell 2.5 % at either end: an interval would feign to know."""


@dataclass(frozen=True, slots=True)
class Interval:
    """A confidence interval."""

    low: float
    high: float


def wilson_interval(k: int, n: int, level: float = LEVEL) -> Interval:
    """Return Wilson's score interval for a rate of `k` in `n`: sound for few trials and for rates near 0 and 1.

    Parameters
    ----------
    k, n : int
        Without trials, nothing is known: 0 to 1.
    level : float

    References
    ----------
    E. B. Wilson, "Probable inference, the law of succession, and statistical inference", JASA 22 (1927).
    """
    if not 0 <= k <= n:
        raise ValueError(f"{k} of {n} is no rate")
    if n == 0:
        return Interval(0.0, 1.0)
    found = binomtest(k, n).proportion_ci(level, method="wilson")
    return Interval(float(found.low), float(found.high))


@dataclass(frozen=True, slots=True)
class Reduction:
    """By how much failures are fewer than the reference's.

    Attributes
    ----------
    value : float or None
        ``1 - failures / failures of the reference``; None where the reference never failed.
    interval : Interval or None
        None with fewer than `MIN_CLUSTERS` clusters in which the reference failed.
    undefined : float
        Share of the bootstrap's resamples in which the reference never failed; they are left out.
    """

    value: float | None
    interval: Interval | None
    undefined: float


def failure_reduction(
    reference: ArrayLike, other: ArrayLike, level: float = LEVEL, resamples: int = RESAMPLES, seed: int = 0
) -> Reduction:
    """Return the reduction of failures, with a percentile interval of a bootstrap over clusters.

    Whole clusters are drawn, not trials: trials of one sequence in one condition fail for the same reasons, so that
    they are far from independent.

    Parameters
    ----------
    reference, other : (C,) int
        Failures in each cluster of either variant, on the same trials.
    level : float
    resamples, seed : int
    """
    base, new = np.asarray(reference, float), np.asarray(other, float)
    if base.shape != new.shape or base.ndim != 1:
        raise ValueError("both variants need one number for each cluster")
    if base.sum() == 0:
        return Reduction(None, None, 1.0)
    value = float(1 - new.sum() / base.sum())
    if (base > 0).sum() < MIN_CLUSTERS:
        return Reduction(value, None, 0.0)
    drawn = np.random.default_rng([seed, 0xB007]).multinomial(len(base), np.full(len(base), 1 / len(base)), resamples)
    base_sums, new_sums = drawn @ base, drawn @ new
    defined = base_sums > 0
    reductions = 1 - new_sums[defined] / base_sums[defined]
    low, high = np.quantile(reductions, [0.5 - level / 2, 0.5 + level / 2]).tolist()
    return Reduction(value, Interval(low, high), float(1 - defined.mean()))
