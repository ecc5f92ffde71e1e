"""Relative poses that two matched views allow: by the turn of what is far, an essential matrix, a homography."""

from __future__ import annotations

import numpy as np
import poselib

from dualslam.core.chi_square import CHI2_95, MEDIAN_CHI2
from dualslam.core.geometry import se3
from dualslam.core.geometry.two_view import (
    decompose_homography,
    fundamental_from_pose,
    homography_transfer_error,
    sampson_error,
)
from dualslam.core.noise_model import TINY
from dualslam.core.types import FloatArray
from dualslam.frontends.tracking.resection import poselib_camera
from dualslam.frontends.tracking.turn_hypotheses import TurnHypotheses

PLANAR_SHARE = 0.6
"""Of what the essential matrix explains: a board gives 0.65 and more, a street 0.3 to 0.4, a room 0.3 to 0.7."""

MIN_NOISE2 = 0.04
"""Of pixels a fifth as noisy as supposed: below, the pictures are drawn, and what is off is the lens."""


class RelativePoses:
    """The relative poses that two matched views allow, to be asked for in the order of what they cost.

    - `sigma_px` (N,), `K` (3, 3), `size_px` (width, height).
    - `uv_a_px`, `uv_b_px` (N, 2): matched pixels, undistorted; N > 0.
    """

    def __init__(
        self,
        uv_a_px: FloatArray,
        uv_b_px: FloatArray,
        sigma_px: FloatArray,
        K: FloatArray,
        size_px: tuple[int, int],
        seed: int,
    ) -> None:
        self._uv_a, self._uv_b, self._sigma_px = uv_a_px, uv_b_px, sigma_px
        self._K, self._size_px, self._seed = K, size_px, seed
        self._turns = TurnHypotheses(uv_a_px, uv_b_px, sigma_px, K, seed)

    @property
    def n_moved(self) -> int:
        """Matches that a turn does not explain; without them there is nothing to tell a translation from."""
        return self._turns.n_moved

    def of_turns(self) -> list[FloatArray]:
        """Return T_b_a (4, 4), translation of length 1, with the turns that what is far shows: two at most."""
        camera = poselib_camera(self._K, self._size_px)
        # Refined, what is of one basin with another comes to the same, and no longer looks like a second answer.
        scale_px = 2.0 * float(np.median(self._sigma_px))
        refinement = {"loss_type": "TRUNCATED", "loss_scale": scale_px, "max_iterations": 25}
        poses = []
        for by_turn in self._turns.poses():
            start = poselib.CameraPose()
            start.R, start.t = se3.rotation(by_turn), se3.translation(by_turn)
            refined, _ = poselib.refine_relative_pose(self._uv_a, self._uv_b, start, camera, camera, refinement)
            poses.append(_unit_baseline(refined.R, refined.t))
        return poses

    def of_essential_matrix(self) -> FloatArray:
        """Return the T_b_a that explains most of the matches."""
        return estimate_relative_pose(self._uv_a, self._uv_b, self._sigma_px, self._K, self._size_px, self._seed)

    def of_plane(self, T_b_a: FloatArray) -> list[FloatArray]:
        """Return the four T_b_a of a homography, where it explains most of what the essential matrix' pose does.

        Before a plane a homography explains as much with less freedom. Only the matches that the essential matrix
        explains are used: wrong ones meet a line by chance, a point hardly ever.
        """
        uv_a, uv_b, variance = self._uv_a, self._uv_b, self._sigma_px**2
        gate_px = 3.0 * float(np.median(self._sigma_px))
        options = {"max_reproj_error": gate_px, "max_iterations": 1000, "min_iterations": 100, "seed": self._seed}
        H_b_a, _ = poselib.estimate_homography(uv_a, uv_b, options, {})
        sampson2 = np.asarray(sampson_error(fundamental_from_pose(self._K, T_b_a), uv_a, uv_b), np.float64)
        right = sampson2 < CHI2_95[1] * variance
        # Pixels are better than their sigmas suppose: how much better, the epipolar distances tell. A point transferred
        # has the noise of both images.
        noise2 = float(np.median(sampson2[right] / variance[right])) / MEDIAN_CHI2[1] if right.any() else 1.0
        transfer2 = np.asarray(homography_transfer_error(H_b_a, uv_a, uv_b).mean(axis=1), np.float64)
        flat = transfer2 < CHI2_95[2] * 2.0 * variance * np.clip(noise2, MIN_NOISE2, 1.0)
        share = float((right & flat).sum() / max(int(right.sum()), 1))
        poses = decompose_homography(H_b_a, self._K).T_b_a if share > PLANAR_SHARE else ()
        return [_unit_baseline(se3.rotation(T), se3.translation(T)) for T in poses]


def estimate_relative_pose(
    uv_a_px: FloatArray, uv_b_px: FloatArray, sigma_px: FloatArray, K: FloatArray, size_px: tuple[int, int], seed: int
) -> FloatArray:
    """Return T_b_a (4, 4) with a baseline of 1: the essential matrix that explains most of the matches."""
    camera = poselib_camera(K, size_px)
    gate_px = 2.0 * float(np.median(sigma_px))
    options = {"max_epipolar_error": gate_px, "max_iterations": 1000, "min_iterations": 100, "seed": seed}
    pose, _ = poselib.estimate_relative_pose(uv_a_px, uv_b_px, camera, camera, options, {})
    return _unit_baseline(pose.R, pose.t)


def _unit_baseline(R_b_a: FloatArray, t_b_a: FloatArray) -> FloatArray:
    return se3.from_parts(R_b_a, t_b_a / max(float(np.linalg.norm(t_b_a)), TINY))
