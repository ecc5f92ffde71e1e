"""Relative poses that two matched views allow.

From an essential matrix; for planes, from a homography; and from the turn that what is far shows by itself, which a
near plane can hide from both: a pose that takes the turn for parallax has points in front of the camera where the true
one, for what is far, has none, and wins the count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import poselib

from dualslam.core.geometry.two_view import (
    decompose_homography,
    fundamental_from_pose,
    homography_transfer_error,
    sampson_error,
)
from dualslam.core.types import FloatArray, IntArray
from dualslam.frontends.gates import CHI2_1DOF_95, CHI2_2DOF_95
from dualslam.frontends.tracking.resection import poselib_camera

N_SAMPLES = 200
"""Pairs of matches that a turn, and then a translation, is tried from: of a layer of a sixth, one at 99.6 %."""
N_LAYERS = 2
MIN_FAR, MIN_FAR_SHARE = 20, 0.1
"""Matches, and their share of all, that must move as one turn does to be a layer of far points and not chance."""


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
) -> Hypotheses:
    """Estimate essential matrix and homography, and return the relative poses that deserve a closer look.

    The scores are truncated sums of squared whitened residuals, as in ORB-SLAM (Mur-Artal et al. 2015, Sec. IV): with
    both counted up to the same bound, the model with the larger sum explains more of the matches.
    """
    camera = poselib_camera(K, size_px)
    sigma = float(np.median(sigma_px))
    options = {"max_epipolar_error": 2.0 * sigma, "max_iterations": 1000, "min_iterations": 100, "seed": seed}
    pose, _ = poselib.estimate_relative_pose(uv_a_px, uv_b_px, camera, camera, options, {})
    T_b_a = np.eye(4)
    T_b_a[:3] = pose.Rt
    options = {"max_reproj_error": 3.0 * sigma, "max_iterations": 1000, "min_iterations": 100, "seed": seed}
    H_b_a, _ = poselib.estimate_homography(uv_a_px, uv_b_px, options, {})
    variance = sigma_px**2
    score_e = _score(sampson_error(fundamental_from_pose(K, T_b_a), uv_a_px, uv_b_px) / variance, CHI2_1DOF_95)
    score_h = _score(homography_transfer_error(H_b_a, uv_a_px, uv_b_px).mean(axis=1) / variance, CHI2_2DOF_95)
    share = score_h / max(score_e + score_h, 1e-12)
    candidates = [_unit_baseline(T_b_a)]
    # Refined, what is of one basin with another comes to the same, and no longer looks like a second answer.
    refinement = {"loss_type": "TRUNCATED", "loss_scale": 2.0 * sigma, "max_iterations": 25}
    for by_turn in _poses_by_turn(uv_a_px, uv_b_px, sigma_px, K, np.random.default_rng(seed)):
        start = poselib.CameraPose()
        start.R, start.t = by_turn[:3, :3], by_turn[:3, 3]
        refined, _ = poselib.refine_relative_pose(uv_a_px, uv_b_px, start, camera, camera, refinement)
        T = np.eye(4)
        T[:3] = refined.Rt
        candidates.append(_unit_baseline(T))
    if share > homography_ratio:
        candidates += [_unit_baseline(T) for T in decompose_homography(H_b_a, K).T_b_a]
    return Hypotheses(candidates, share)


def _poses_by_turn(
    uv_a_px: FloatArray, uv_b_px: FloatArray, sigma_px: FloatArray, K: FloatArray, rng: np.random.Generator
) -> list[FloatArray]:
    """Return poses whose rotation a layer of points shows alone, and whose translation the others fit best with it.

    The first layer may be a near plane that moved like a turn: what it leaves is asked for the next.
    """
    rays_a, rays_b = _rays(uv_a_px, K), _rays(uv_b_px, K)
    gate = CHI2_2DOF_95 * 2.0 * sigma_px**2  # both pixels have noise
    enough = max(MIN_FAR, MIN_FAR_SHARE * len(rays_a))
    left, poses = np.arange(len(rays_a)), []
    for _ in range(N_LAYERS):
        if len(left) < enough:
            break
        i, j = left[rng.integers(len(left), size=(2, N_SAMPLES))]
        turns = _triads(rays_b[i], rays_b[j]) @ _triads(rays_a[i], rays_a[j]).swapaxes(1, 2)
        n_fit = [np.count_nonzero(_turned_error2(rays_a[left], uv_b_px[left], K, R) < gate[left]) for R in turns]
        R = turns[int(np.argmax(n_fit))]
        layer = left[_turned_error2(rays_a[left], uv_b_px[left], K, R) < gate[left]]
        R = _kabsch(rays_a[layer], rays_b[layer])
        far = _turned_error2(rays_a, uv_b_px, K, R) < gate
        left = left[~far[left]]
        if far.sum() < enough:
            break
        t = _direction(R, np.flatnonzero(~far), rays_a, rays_b, uv_a_px, uv_b_px, sigma_px, K, rng)
        if t is not None:
            T_b_a = np.eye(4)
            T_b_a[:3, :3], T_b_a[:3, 3] = R, t
            poses.append(T_b_a)
    return poses


def _direction(
    R: FloatArray,
    near: IntArray,
    rays_a: FloatArray,
    rays_b: FloatArray,
    uv_a_px: FloatArray,
    uv_b_px: FloatArray,
    sigma_px: FloatArray,
    K: FloatArray,
    rng: np.random.Generator,
) -> FloatArray | None:
    """Return the direction of translation that most matches allow with a rotation; None where none has parallax."""
    if len(near) < MIN_FAR:
        return None
    turned = rays_a[near] @ R.T
    normals = np.cross(turned, rays_b[near])  # the translation is at right angles to each
    i, j = rng.integers(len(near), size=(2, N_SAMPLES))
    directions = np.cross(normals[i], normals[j])
    length = np.linalg.norm(directions, axis=1)
    directions = directions[length > 1e-12] / length[length > 1e-12, None]
    if len(directions) == 0:
        return None
    fits = [(_sampson_of(R, t, uv_a_px, uv_b_px, K) < CHI2_1DOF_95 * sigma_px**2).sum() for t in directions]
    t = directions[int(np.argmax(fits))]
    # Of its two signs the one with more points in front: the parallax turns a ray towards the translation.
    ahead = np.einsum("ni,ni->n", normals, np.cross(turned, np.broadcast_to(t, turned.shape)))
    return np.asarray(t if np.count_nonzero(ahead > 0) * 2 > len(near) else -t)


def _rays(uv_px: FloatArray, K: FloatArray) -> FloatArray:
    rays = np.column_stack([uv_px, np.ones(len(uv_px))]) @ np.linalg.inv(K).T
    return np.asarray(rays / np.linalg.norm(rays, axis=1)[:, None])


def _triads(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return (N, 3, 3) right-handed frames of pairs of rays, an axis a column."""
    across = np.cross(first, second)
    across /= np.maximum(np.linalg.norm(across, axis=1), 1e-12)[:, None]
    return np.stack([first, across, np.cross(first, across)], axis=2)


def _kabsch(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the rotation that takes rays a to b with the least squared error."""
    U, _, Vt = np.linalg.svd(b.T @ a)
    return np.asarray(U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt)


def _turned_error2(rays_a: FloatArray, uv_b_px: FloatArray, K: FloatArray, R: FloatArray) -> FloatArray:
    """Return squared distances of the second view's pixels from where a turn alone takes those of the first."""
    turned = rays_a @ (K @ R).T
    uv = turned[:, :2] / np.where(turned[:, 2:] > 1e-9, turned[:, 2:], np.inf)
    return np.asarray(((uv - uv_b_px) ** 2).sum(axis=1))


def _sampson_of(R: FloatArray, t: FloatArray, uv_a_px: FloatArray, uv_b_px: FloatArray, K: FloatArray) -> FloatArray:
    T_b_a = np.eye(4)
    T_b_a[:3, :3], T_b_a[:3, 3] = R, t
    return sampson_error(fundamental_from_pose(K, T_b_a), uv_a_px, uv_b_px)


def _unit_baseline(T_b_a: FloatArray) -> FloatArray:
    T = T_b_a.copy()
    T[:3, 3] /= max(float(np.linalg.norm(T[:3, 3])), 1e-12)
    return T


def _score(squared: FloatArray, gate: float) -> float:
    return float(np.sum(np.where(squared < gate, CHI2_2DOF_95 - squared, 0.0)))
