"""Is this map still consistent with what the camera sees? A verdict for every tracked frame, with its reason."""

from __future__ import annotations

from dualslam.core.config import HealthConfig
from dualslam.core.types import Failure, FailureReason, Track


def judge_track(track: Track | Failure, config: HealthConfig) -> Track | Failure:
    """Return the track if the map explains it, else why not.

    Parameters
    ----------
    track : Track or Failure
        What the tracker made of a frame.
    config : HealthConfig
        Thresholds, each with its meaning.
    """
    if isinstance(track, Failure):
        return track
    numbers = {"n_matches": float(track.n_matches), "n_inliers": float(track.n_inliers), "chi2": track.chi2}
    if track.n_inliers < config.min_inliers:
        return Failure(FailureReason.TOO_FEW_INLIERS, f"{track.n_inliers} landmarks agree with the pose", numbers)
    ratio = track.n_inliers / max(track.n_matches, 1)
    if ratio < config.min_inlier_ratio:
        return Failure(FailureReason.LOW_INLIER_RATIO, f"{ratio:.0%} of the matches agree with the pose", numbers)
    if track.chi2 > config.max_chi2:
        return Failure(FailureReason.CHI_SQUARE, f"chi-square per degree of freedom {track.chi2:.1f}", numbers)
    return track
