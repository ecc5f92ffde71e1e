"""Silent breaks: short stretches of a trajectory that do not fit the truth, whatever one alignment of the whole says.

A map that lost its scale for two seconds can have a small error over the whole, and report no failure. So each stretch
is laid on the truth by itself: its own scale must be that of the others, and its shape that of the way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualslam.core.types import BoolArray, FloatArray
from dualslam.lab.metrics.alignment import align_points

STRETCH_S = 2.0
"""Seconds' worth of consecutive posed frames that a stretch is long, so that it reaches across what has no pose."""
STEP_S = 0.5
MIN_STRETCH_POSES = 8
MAX_SCALE_RATIO = 1.15
"""Largest ratio between a stretch's scale and the median of all."""
MAX_SHAPE_ERROR = 0.05
"""Largest RMS distance of a stretch, laid on the truth by itself, of the way there."""
MIN_SPREAD_M, MIN_SPREAD_SHARE = 0.05, 0.1
"""A stretch is judged where the truth spreads by more than this, and by more than this share of the median stretch."""

_TINY = 1e-12


@dataclass(frozen=True, slots=True)
class SilentBreaks:
    """How many stretches were judged and how many are broken.

    Attributes
    ----------
    judged, broken : int
        Stretches in which the truth moves, and those of them that do not fit it.
    broken_pct : float or None
        Of the judged ones; None where none was.
    first_broken_s : float or None
        When the first broken one begins, in seconds from the sequence's first frame.
    """

    judged: int
    broken: int | None = None
    broken_pct: float | None = None
    first_broken_s: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Stretches:
    """The stretches of a trajectory, each laid on the truth by itself.

    Attributes
    ----------
    first_s : (S,) float64
        When each begins, in seconds from the sequence's first frame.
    judged : (S,) bool
        Whether the truth moves in it.
    scale_ratio : (S,) float64
        Its own scale over the median of those that are judged.
    shape : (S,) float64
        RMS distance that its own alignment leaves, over the way there.
    """

    first_s: FloatArray
    judged: BoolArray
    scale_ratio: FloatArray
    shape: FloatArray

    @property
    def broken(self) -> BoolArray:
        """(S,) which do not fit the truth."""
        off = np.abs(np.log(np.maximum(self.scale_ratio, _TINY))) > np.log(MAX_SCALE_RATIO)
        return np.asarray(self.judged & (off | (self.shape > MAX_SHAPE_ERROR)))


def judge_stretches(times_s: FloatArray, p: FloatArray, q: FloatArray, frame_dt_s: float) -> Stretches | None:
    """Lay all stretches of a trajectory on the truth.

    Parameters
    ----------
    times_s : (N,) float64
        Of the posed frames, ascending, from the sequence's first frame.
    p, q : (N, 3) float64
        Estimated and true positions.
    frame_dt_s : float
        Between neighbouring frames of the sequence.

    Returns
    -------
    Stretches or None
        None where there are too few poses for a single stretch.
    """
    n, step = max(MIN_STRETCH_POSES, round(STRETCH_S / frame_dt_s)), max(1, round(STEP_S / frame_dt_s))
    firsts = np.arange(0, len(p) - n + 1, step)
    if len(firsts) == 0:
        return None
    fits = np.array([_fit(p[k : k + n], q[k : k + n]) for k in firsts.tolist()])
    spread, scale, rms, way = fits.T
    judged = spread > max(MIN_SPREAD_SHARE * float(np.median(spread)), MIN_SPREAD_M)
    usual = max(float(np.median(scale[judged])), _TINY) if judged.any() else 1.0
    return Stretches(times_s[firsts], judged, scale / usual, rms / np.maximum(way, _TINY))


def find_silent_breaks(times_s: FloatArray, p: FloatArray, q: FloatArray, frame_dt_s: float) -> SilentBreaks | None:
    """Count the stretches that do not fit the truth; parameters as of `judge_stretches`."""
    stretches = judge_stretches(times_s, p, q, frame_dt_s)
    if stretches is None:
        return None
    judged, broken = int(stretches.judged.sum()), stretches.broken
    if not judged:
        return SilentBreaks(0)
    first = float(stretches.first_s[np.argmax(broken)]) if broken.any() else None
    return SilentBreaks(judged, int(broken.sum()), 100.0 * float(broken.sum() / judged), first)


def _fit(p: FloatArray, q: FloatArray) -> tuple[float, float, float, float]:
    """Return how far the truth spreads, the stretch's own scale, what is left after its alignment, and the true way."""
    scale, R, t = align_points(p, q)
    rms = np.sqrt(((q - (scale * p @ R.T + t)) ** 2).sum(axis=1).mean())
    spread = np.sqrt(((q - q.mean(axis=0)) ** 2).sum(axis=1).mean())
    return float(spread), scale, float(rms), float(np.linalg.norm(np.diff(q, axis=0), axis=1).sum())
