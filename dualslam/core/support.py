"""Whether enough of what a frame sees agrees with a pose."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dualslam.core.decisions import Gate
from dualslam.core.types import Failure, FailureReason, Track

if TYPE_CHECKING:
    from dualslam.core.config.settings import HealthConfig

MIN_INLIER_RATIO = 0.35
"""Share of the matched landmarks that must agree with a pose."""
MAX_CHI2 = 2.5
"""Mean squared whitened residual per degree of freedom of those that agree (1 is expected)."""


def find_lack_of_support(n_inliers: int, n_matches: int, chi2: float, config: HealthConfig) -> Failure | None:
    """Return what a pose lacks, or None where its matches explain it.

    - `n_inliers`, `n_matches`: matches that agree with the pose, and all of them.
    - `chi2`: of those that agree, over the degrees of freedom.
    """
    numbers = {"n_matches": float(n_matches), "n_inliers": float(n_inliers), "chi2": chi2}
    gates = support_gates(n_inliers, n_matches, chi2, config)
    few, low, misfit = gates
    if not few.passed:
        reason, detail = FailureReason.TOO_FEW_INLIERS, f"{n_inliers} landmarks agree with the pose"
    elif not low.passed:
        reason, detail = FailureReason.LOW_INLIER_RATIO, f"{low.value:.0%} of the matches agree with the pose"
    elif misfit.value > misfit.threshold:
        reason, detail = FailureReason.CHI_SQUARE, f"chi-square per degree of freedom {chi2:.1f}"
    else:
        return None
    return Failure(reason, detail, numbers, gates=gates)


def support_gates(n_inliers: int, n_matches: int, chi2: float, config: HealthConfig) -> tuple[Gate, Gate, Gate]:
    """Return the comparisons of `find_lack_of_support`, in their order."""
    return (
        Gate("inliers", n_inliers, ">=", config.min_inliers),
        Gate("share of inliers", n_inliers / max(n_matches, 1), ">=", MIN_INLIER_RATIO),
        Gate("chi-square per degree of freedom", chi2, "<=", MAX_CHI2),
    )


def judge_track(track: Track | Failure, config: HealthConfig) -> Track | Failure:
    """Return the track if the map explains it, else why not."""
    if isinstance(track, Failure):
        return track
    lack = find_lack_of_support(track.n_inliers, track.n_matches, track.chi2, config)
    return track if lack is None else lack
