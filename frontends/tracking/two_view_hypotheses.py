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


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses:
    """What two views allow.

    Attributes
    ----------
    T_b_a : list of (4, 4) float64
        Candidate poses, translation of length 1.
    homography_share : float
        Score of the homography in the sum of both scores: high for a plane or a pure turn.
    """

    T_b_a: list[FloatArray]
    homography_share: float


def propose_relative_poses(
    uv_a_px: FloatArray,
    uv_b_px: FloatArray,
    sigma_px: FloatArray,
    K: FloatArray,
    size_px: tuple[int, int],
    homography_ratio: float,
    seed: int,
    min_moved: int,
) -> Hypotheses | Failure:
    """Estimate essential matrix and homography, and return the relative poses that deserve a closer look.

    The scores are truncated sums of squared whitened residuals, as in ORB-SLAM (Mur-Artal et al. 2015, Sec. IV): with
    both counted up to the same bound, the model with the larger sum explains more of the matches. With fewer than
    `min_moved` matches that a turn does not explain, there is nothing to tell a translation from: no pose is sought.
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
    score_e = _score(sampson_error(fundamental_from_pose(K, T_b_a), uv_a_px, uv_b_px) / variance, CHI2_95[1])
    score_h = _score(homography_transfer_error(H_b_a, uv_a_px, uv_b_px).mean(axis=1) / variance, CHI2_95[2])
    share = score_h / max(score_e + score_h, 1e-12)
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
    if share > homography_ratio:
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


def _score(squared: FloatArray, gate: float) -> float:
    return float(np.sum(np.where(squared < gate, CHI2_95[2] - squared, 0.0)))
