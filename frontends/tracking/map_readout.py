"""The readout time of a rolling shutter, by what a map's own observations say of it.

In a bundle of the keyframes that turn fast it is one more unknown, beside their poses and points: the camera sees each
line in another orientation, and the frames around it give the rate of turn. A map, whose points are known from other
views, shows it to about a millisecond; pairs of frames only separate 20 ms from none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import sparse

from dualslam.core.arrays import rank_in_runs
from dualslam.core.chi_square import MEDIAN_CHI2, huber_weights
from dualslam.core.estimates import ReadoutEstimate
from dualslam.core.geometry import se3, so3
from dualslam.core.geometry.projection import project_points, projection_jacobians
from dualslam.core.noise_model import DAMPING, MIN_DEPTH_MU, PROOF_VIEWS, ROBUST_K, TINY
from dualslam.core.types import BoolArray, Failure, FailureReason, FloatArray, IntArray
from dualslam.frontends.tracking.turning import read_at
from dualslam.map.submap import Submap

MAX_KEYFRAMES = 40
"""Neighbours in time; of all such windows the one with most turning."""
MIN_KEYFRAMES = 8
PER_KEYFRAME = 150
"""Observations of each, of the landmarks with the longest tracks: they tell, and bound the time (0.1 s)."""
MIN_OBSERVATIONS = 500
STEPS = 4
"""Gauss-Newton steps: the map is at its optimum without the readout time, and each step goes two thirds of what is
left (1.4, 1.7, 1.9 of 1.95 ms)."""


@dataclass(slots=True, eq=False)
class ReadoutQuestion:
    """F keyframes, N points, R observations; poses, points and readout time are estimated. It can be pickled."""

    K: FloatArray
    T_cam_submap: FloatArray  # (F, 4, 4)
    xyz: FloatArray  # (N, 3)
    kf: IntArray  # (R,)
    point: IntArray  # (R,)
    uv_px: FloatArray  # (R, 2)
    sigma_px: FloatArray  # (R,)
    by_readout: FloatArray  # (R, 2): by how much a pixel moves with each second of readout
    readout_s: float = 0.0

    def residuals(self) -> tuple[FloatArray, BoolArray]:
        """Return whitened residuals (R, 2), and which points are before their camera."""
        found, depth = np.zeros((len(self.kf), 2)), np.zeros(len(self.kf))
        for f, T in enumerate(self.T_cam_submap):
            rows = np.flatnonzero(self.kf == f)
            found[rows], depth[rows] = project_points(self.K, T, self.xyz[self.point[rows]])
        found += self.readout_s * self.by_readout
        front = depth > MIN_DEPTH_MU
        return np.where(front[:, None], (found - self.uv_px) / self.sigma_px[:, None], 0.0), front


def ask_readout(
    submap: Submap, rates_rad_s: Mapping[int, FloatArray], size_px: tuple[int, int]
) -> ReadoutQuestion | Failure:
    """Ask a submap for how much longer its images were read than its features were corrected for.

    - `submap`: is not changed.
    - `rates_rad_s` (mapping of int to (3,)): how the camera turns at each keyframe, in its own axes; those that are
      missing tell nothing.
    - `size_px`: width and height of the image.
    """
    ids = np.array(sorted(k for k in submap.keyframes if k in rates_rad_s), np.int64)
    if len(ids) < MIN_KEYFRAMES:
        return Failure(FailureReason.DEGENERATE, f"{len(ids)} keyframes")
    rates = np.array([rates_rad_s[k] for k in ids.tolist()])
    chosen = _most_turning(rates)
    question = _collect(submap, ids[chosen], rates[chosen], size_px)
    if len(question.kf) < MIN_OBSERVATIONS:
        return Failure(FailureReason.TOO_FEW_INLIERS, f"{len(question.kf)} observations")
    return question


def answer_readout(question: ReadoutQuestion) -> ReadoutEstimate:
    """Solve the bundle."""
    bundle, sigma_s = replace(question), np.inf
    for _ in range(STEPS):
        sigma_s = _step(bundle)
    residuals, front = bundle.residuals()
    noise = float(np.sqrt(np.median((residuals[front] ** 2).sum(1)) / MEDIAN_CHI2[2]))
    return ReadoutEstimate(bundle.readout_s, sigma_s * noise, len(bundle.T_cam_submap), len(bundle.kf))


def _most_turning(rates_rad_s: FloatArray) -> slice:
    """Return which `MAX_KEYFRAMES` neighbours turn most."""
    n = len(rates_rad_s)
    if n <= MAX_KEYFRAMES:
        return slice(0, n)
    turn2 = np.concatenate([[0.0], np.cumsum((rates_rad_s**2).sum(1))])
    within = turn2[MAX_KEYFRAMES:] - turn2[:-MAX_KEYFRAMES]
    first = int(np.argmax(within))
    return slice(first, first + MAX_KEYFRAMES)


def _collect(submap: Submap, ids: IntArray, rates_rad_s: FloatArray, size_px: tuple[int, int]) -> ReadoutQuestion:
    obs, K = submap.observations, submap.K
    rows = np.flatnonzero(obs["alive"] & np.isin(obs["kf"], ids))
    kf, landmark = np.searchsorted(ids, obs["kf"][rows]), obs["landmark"][rows]
    T = se3.inverse(submap.keyframe_poses(ids))
    depth = np.einsum("rj,rj->r", T[kf, 2, :3], submap.landmarks["xyz_mu"][landmark]) + T[kf, 2, 3]
    rows, kf, landmark = rows[depth > MIN_DEPTH_MU], kf[depth > MIN_DEPTH_MU], landmark[depth > MIN_DEPTH_MU]
    # The longest tracks of each keyframe; then what has views enough among all of them.
    n_views = np.bincount(landmark, minlength=len(submap.landmarks))
    order = np.lexsort((landmark, -n_views[landmark], kf))
    rank = np.empty(len(kf), np.int64)
    rank[order] = rank_in_runs(kf[order])
    wanted = np.zeros(len(submap.landmarks), np.bool_)
    wanted[landmark[rank < PER_KEYFRAME]] = True
    kept = wanted[landmark] & (n_views[landmark] >= PROOF_VIEWS)
    rows, kf, landmark = rows[kept], kf[kept], landmark[kept]
    points, point = np.unique(landmark, return_inverse=True)
    uv, sigma = submap.observed_pixels(rows)
    f, c = np.diag(K)[:2], K[:2, 2]
    rays = np.column_stack([(uv - c) / f, np.ones(len(uv))])
    read_px = np.empty((len(rows), 2))
    for n, k in enumerate(ids.tolist()):
        here = kf == n
        read_px[here] = submap.keyframes[k].features.uv_px[obs["feature"][rows[here]]]
    turned = -np.cross(rates_rad_s[kf] * read_at(read_px, size_px)[:, None], rays)
    by_readout = f * (turned[:, :2] - rays[:, :2] * turned[:, 2:])
    return ReadoutQuestion(K, T, submap.landmarks["xyz_mu"][points], kf, point, uv, sigma, by_readout)


def _step(b: ReadoutQuestion) -> float:
    """Make one Gauss-Newton step; return the readout time's standard deviation, by the pixels' sigmas."""
    residuals, front = b.residuals()
    weight = np.where(front, huber_weights((residuals**2).sum(1), ROBUST_K**2), 0.0)
    J, J_point = _jacobians(b, front, np.sqrt(weight))
    r = (residuals * np.sqrt(weight)[:, None]).reshape(-1)
    H, g, cross = (J.T @ J).toarray(), J.T @ r, (J.T @ J_point).tocsr()
    inverse = _inverse_blocks(J_point)
    g_point = J_point.T @ r
    through = cross @ inverse
    # What no observation moves (a keyframe without a landmark of enough views) stays where it is.
    damping = np.where(np.diag(H) > 0, DAMPING * np.diag(H), 1.0)
    S = H - (through @ cross.T).toarray() + np.diag(damping)
    # The first pose is the gauge; the damping holds the scale of the whole, which nothing else does.
    inverse_S = np.linalg.inv(S[se3.DOF :, se3.DOF :])
    step = np.concatenate([np.zeros(se3.DOF), -inverse_S @ (g - through @ g_point)[se3.DOF :]])
    b.xyz = b.xyz - (inverse @ (g_point + cross.T @ step)).reshape(-1, 3)
    b.T_cam_submap = se3.exp(step[:-1].reshape(-1, se3.DOF)) @ b.T_cam_submap
    b.readout_s += float(step[-1])
    return float(np.sqrt(max(inverse_S[-1, -1], 0.0)))


def _jacobians(b: ReadoutQuestion, front: BoolArray, root_weight: FloatArray) -> tuple[Any, Any]:
    """Return the sparse whitened derivatives: by poses and, last, the readout time (2 R, 6 F + 1); by points (2 R, 3
    N).
    """
    n = len(b.kf)
    J, J_point = np.zeros((n, 2, se3.DOF + 1)), np.zeros((n, 2, 3))
    for f, T in enumerate(b.T_cam_submap):
        rows = np.flatnonzero((b.kf == f) & front)
        J[rows, :, : se3.DOF], J_point[rows] = projection_jacobians(b.K, T, b.xyz[b.point[rows]])
    J[:, :, -1] = b.by_readout
    w = (root_weight / b.sigma_px)[:, None, None]
    column = np.column_stack([se3.DOF * b.kf[:, None] + np.arange(se3.DOF), np.full(n, se3.DOF * len(b.T_cam_submap))])
    shapes = (2 * n, se3.DOF * len(b.T_cam_submap) + 1), (2 * n, 3 * len(b.xyz))
    columns = column, 3 * b.point[:, None] + np.arange(3)
    by_all, by_point = (
        sparse.csr_array(
            ((each * w).reshape(-1), at.repeat(2, axis=0).reshape(-1), np.arange(0, each.size + 1, at.shape[1])),
            shape=shape,
        )
        for each, at, shape in zip((J, J_point), columns, shapes, strict=True)
    )
    return by_all, by_point


def _inverse_blocks(J_point: Any) -> Any:
    """Return the inverse of the points' own blocks (3 N, 3 N), sparse, damped where a depth has no parallax."""
    n = J_point.shape[1] // 3
    H = (J_point.T @ J_point).tobsr((3, 3))
    blocks = np.zeros((n, 3, 3))
    blocks[np.repeat(np.arange(n), np.diff(H.indptr))] = H.data
    damping = DAMPING / 3 * np.trace(blocks, axis1=1, axis2=2) + TINY
    inverse = np.linalg.inv(blocks + damping[:, None, None] * so3.IDENTITY)
    return sparse.bsr_array((inverse, np.arange(n), np.arange(n + 1))).tocsr()
