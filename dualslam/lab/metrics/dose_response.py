"""The critical strength of a disturbance: where half of the runs fail, from runs at many strengths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from dualslam.lab.metrics.statistics import LEVEL, Interval

_CENTRES, _SLOPES = 201, 25
_STEEPNESS = (2.0, 200.0)
"""Slopes that are tried, times the range of the doses. From 27 to 73 % failures over the whole range, to a step within
a fiftieth of it: doses that separate the failures have no steepest slope."""


@dataclass(frozen=True, slots=True)
class CriticalDose:
    """Where half of the runs fail.

    Attributes
    ----------
    value : float or None
        None where it lies outside of the doses that were tried.
    interval : Interval
        Profile-likelihood interval. An end is the end of the doses where they do not bound it.
    is_above, is_below : bool
        Whether half still succeed at the strongest dose, or fail at the weakest.
    """

    value: float | None
    interval: Interval
    is_above: bool = False
    is_below: bool = False


def critical_dose(doses: ArrayLike, failed: ArrayLike, level: float = LEVEL) -> CriticalDose | None:
    """Fit a logistic curve to failures by dose, and return the dose at which half fail.

    Parameters
    ----------
    doses : (N,) float
        The more, the worse. For the reverse, pass their negatives.
    failed : (N,) bool
    level : float
        Of the interval.

    Returns
    -------
    CriticalDose or None
        None where fewer than two different doses were tried.
    """
    x, y = np.asarray(doses, np.float64), np.asarray(failed, bool)
    if len(x) != len(y):
        raise ValueError("each run needs one dose")
    if len(x) == 0 or np.ptp(x) == 0:
        return None
    low, span = float(x.min()), float(np.ptp(x))
    # Centres reach beyond the doses by half their range: a curve may be seen by its tail alone.
    centres = low + span * np.linspace(-0.5, 1.5, _CENTRES)
    slopes = np.geomspace(*_STEEPNESS, _SLOPES) / span
    logit = slopes[None, :, None] * (x - centres[:, None, None])
    likelihood = -np.logaddexp(0.0, np.where(y, -logit, logit)).sum(axis=2)
    profile = likelihood.max(axis=1)
    best = profile.max()
    flat = np.flatnonzero(profile >= best - 1e-6)  # doses that separate the failures: all centres between fit alike
    value = float(np.clip(centres[flat].mean(), centres[0], centres[-1]))
    kept = centres[2.0 * (best - profile) <= chi2.ppf(level, 1)]
    interval = Interval(max(float(kept[0]), low), min(float(kept[-1]), low + span))
    if value > low + span:
        return CriticalDose(None, interval, is_above=True)
    if value < low:
        return CriticalDose(None, interval, is_below=True)
    return CriticalDose(value, interval)
