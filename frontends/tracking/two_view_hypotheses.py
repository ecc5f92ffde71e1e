"""Relative poses that two matched views allow.

From an essential matrix; for planes, from a homography; and from the turn that what is far shows by itself
(`turn_hypotheses`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import poselib

from dualslam.core.chi_square import CHI2_95
from dualslam.core.geometry.two_view import (
    decompose_homography,
    fundamental_from_pose,
    homography_transfer_error,
    sampson_error,
)
from dualslam.core.types import Failure, FailureReason, FloatArray
from dualslam.frontends.tracking.resection import poselib_camera
from dualslam.frontends.tracking.turn_hypotheses import TurnHypotheses

PLANAR_SHARE = 0.6
"""Of what the essential matrix explains: a board gives 0.65 and more (40 pairs of rendered views), a street 0.3 to 0.4,
a room 0.3 to 0.7."""

CHI2_MEDIAN = 0.455
"""Of one degree of freedom."""
MIN_NOISE2 = 0.04
"""Of pixels a fifth as noisy as supposed: below, the pictures are drawn, and what is off is the lens."""


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses:
    """What two views allow.

    Attributes
    ----------
    T_b_a : list of (4, 4) float64
        Candidate poses, translation of length 1.
    homography_share : float
        Of the matches that the essential matrix explains, those that one homography explains as well: high for a plane
        or a pure turn.
    """

    T_b_a: list[FloatArray]
    homography_share: float


def propose_relative_poses(
    uv_a_px: FloatArray,
    uv_b_px: FloatArray,
    sigma_px: FloatArray,
    K: FloatArray,
    size_px: tuple[int, int],
    seed: int,
    min_moved: int,
) -> Hypotheses | Failure:
    """Estimate essential matrix and homography, and return the relative poses that deserve a closer look.

    Before a plane, the essential matrix is anyone's guess: a homography explains as much with less freedom. Only the
    matches that the essential matrix explains are asked, as wrong ones meet a line by chance, a point hardly ever, and
    before a plane that repeats itself there are many. With fewer than `min_moved` matches that a turn does not explain,
    there is nothing to tell a translation from: no pose is sought.
    """
    turns = TurnHypotheses(uv_a_px, uv_b_px, sigma_px, K, seed)
    if turns.n_moved < min_moved:
        return Failure(FailureReason.LOW_PARALLAX, f"a turn explains all but {turns.n_moved} of {len(uv_a_px)} matches")
    camera = poselib_camera(K, size_px)
    sigma = float(np.median(sigma_px))
    T_b_a = estimate_relative_pose(uv_a_px, uv_b_px, sigma_px, K, size_px, seed)
    options = {"max_reproj_error": 3.0 * sigma, "max_iterations": 1000, "min_iterations": 100, "seed": seed}
    H_b_a, _ = poselib.estimate_homography(uv_a_px, uv_b_px, options, {})
    variance = sigma_px**2
    sampson2 = np.asarray(sampson_error(fundamental_from_pose(K, T_b_a), uv_a_px, uv_b_px), np.float64)
    right = sampson2 < CHI2_95[1] * variance
    # Pixels are better than their sigmas suppose: how much better, the epipolar distances tell. A point transferred has
    # the noise of both images.
    noise2 = float(np.median(sampson2[right] / variance[right])) / CHI2_MEDIAN if right.any() else 1.0
    transfer2 = np.asarray(homography_transfer_error(H_b_a, uv_a_px, uv_b_px).mean(axis=1), np.float64)
    flat = transfer2 < CHI2_95[2] * 2.0 * variance * np.clip(noise2, MIN_NOISE2, 1.0)
    share = float((right & flat).sum() / max(int(right.sum()), 1))
    candidates = [T_b_a]
    # Refined, what is of one basin with another comes to the same, and no longer looks like a second answer.
    refinement = {"loss_type": "TRUNCATED", "loss_scale": 2.0 * sigma, "max_iterations": 25}
    for by_turn in turns.poses():
        start = poselib.CameraPose()
        start.R, start.t = by_turn[:3, :3], by_turn[:3, 3]
        refined, _ = poselib.refine_relative_pose(uv_a_px, uv_b_px, start, camera, camera, refinement)
        T = np.eye(4)
        T[:3] = refined.Rt
        candidates.append(_unit_baseline(T))
    if share > PLANAR_SHARE:
        candidates += [_unit_baseline(T) for T in decompose_homography(H_b_a, K).T_b_a]
    return Hypotheses(candidates, share)


def estimate_relative_pose(
    uv_a_px: FloatArray, uv_b_px: FloatArray, sigma_px: FloatArray, K: FloatArray, size_px: tuple[int, int], seed: int
) -> FloatArray:
    """Return T_b_a (4, 4) with a baseline of 1: the essential matrix that explains most of the matches."""
    camera = poselib_camera(K, size_px)
    gate_px = 2.0 * float(np.median(sigma_px))
    options = {"max_epipolar_error": gate_px, "max_iterations": 1000, "min_iterations": 100, "seed": seed}
    pose, _ = poselib.estimate_relative_pose(uv_a_px, uv_b_px, camera, camera, options, {})
    T_b_a = np.eye(4)
    T_b_a[:3] = pose.Rt
    return _unit_baseline(T_b_a)


def _unit_baseline(T_b_a: FloatArray) -> FloatArray:
    T = T_b_a.copy()
    T[:3, 3] /= max(float(np.linalg.norm(T[:3, 3])), 1e-12)
    return T
