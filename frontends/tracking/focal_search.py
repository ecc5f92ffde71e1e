"""The focal length of a camera of which nothing is known, from the first seconds of its video.

Pairs of frames some way apart are asked for a relative pose and one focal length (six-point solver and refinement of
PoseLib). A pair by itself may be wrong by half: a turn, a plane or a straight drive leave the focal length open. Many
pairs agree about the right one, which is where their estimates are densest. Self-calibration goes on from there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import poselib

from dualslam.core.camera.focal import FocalSearch
from dualslam.core.interfaces import Frontend
from dualslam.core.types import Failure, FailureReason, Features, FloatArray

LAGS = (5, 10, 20, 40)
"""Frames between the two of a pair."""
MIN_MATCHES, MIN_INLIERS, MIN_PAIRS = 100, 60, 8
MIN_MOTION = 0.02
"""Median way of the matches, of the image's width: less says nothing."""
RANGE = (0.3, 3.0)
"""Focal lengths of cameras, over the width: 118 to 19 degrees."""
BANDWIDTH = 0.08
"""Of the density over the logarithm: about what one good pair is off by."""
SPREAD_PCT = (16.0, 84.0)
"""Percentiles of the pairs between which the focal length is said to lie."""


def search_focal(
    frontend: Frontend, features: Sequence[Features], size_px: tuple[int, int], seed: int
) -> FocalSearch | Failure:
    """Search for the focal length that pairs of frames agree about.

    Parameters
    ----------
    frontend : Frontend
        Whose features these are.
    features : sequence of Features
        Of neighbouring frames.
    size_px : (int, int)
        Width and height.
    seed : int

    Returns
    -------
    FocalSearch or Failure
        Fewer than `MIN_PAIRS` pairs had an answer: `LOW_PARALLAX`.
    """
    found = []
    for lag in LAGS:
        for first in range(0, len(features) - lag, max(lag // 2, LAGS[0])):
            focal = _of_pair(frontend, features[first], features[first + lag], size_px, seed)
            if focal is not None:
                found.append(focal)
    if len(found) < MIN_PAIRS:
        return Failure(
            FailureReason.LOW_PARALLAX, f"{len(found)} pairs of frames tell the focal length, {MIN_PAIRS} needed"
        )
    log_focal = np.log(np.array(found))
    grid = np.linspace(log_focal.min(), log_focal.max(), 400)
    density = np.exp(-0.5 * ((grid[:, None] - log_focal) / BANDWIDTH) ** 2).sum(axis=1)
    best = float(np.exp(grid[int(np.argmax(density))]))
    low, high = np.exp(np.percentile(log_focal, SPREAD_PCT)).tolist()
    return FocalSearch(best, min(low, best), max(high, best), size_px[0], len(found))


def _of_pair(frontend: Frontend, a: Features, b: Features, size_px: tuple[int, int], seed: int) -> float | None:
    if min(len(a), len(b)) < MIN_MATCHES:
        return None
    index = frontend.match_wide(a, b).index
    if len(index) < MIN_MATCHES:
        return None
    uv_a, uv_b = a.uv_px[index[:, 0]], b.uv_px[index[:, 1]]
    if np.median(np.linalg.norm(uv_a - uv_b, axis=1)) < MIN_MOTION * size_px[0]:
        return None
    sigma = float(np.median(np.concatenate([a.sigma_px[index[:, 0]], b.sigma_px[index[:, 1]]])))
    middle: FloatArray = 0.5 * (np.array(size_px, float) - 1.0)
    options = {"max_epipolar_error": 2.0 * sigma, "max_iterations": 500, "min_iterations": 100, "seed": seed}
    pair, info = poselib.estimate_shared_focal_relative_pose(uv_a, uv_b, middle, options, {})
    focal = float(pair.camera1.params[0])
    if np.count_nonzero(info["inliers"]) < MIN_INLIERS or not RANGE[0] < focal / size_px[0] < RANGE[1]:
        return None
    return focal
