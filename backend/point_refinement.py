"""Points that are no variables of the graph: refined by their views with the poses held."""

from __future__ import annotations

import numpy as np

from dualslam.backend.observability import projection_jacobian, reproject, sum_products
from dualslam.core.geometry import so3
from dualslam.core.noise_model import TINY
from dualslam.core.types import FloatArray, IntArray
from dualslam.map.submap import Submap

STEPS = 2
"""Gauss-Newton steps: from where the last ones left it a point moves as little as its poses did."""
REFIT_STEPS = 3
"""The same for poses that have moved farther: after a loop, or a batch adjustment without these points."""
DAMPING = 1e-6
"""Relative to the trace of a point's information: keeps the depth of one seen along a single line where it is."""


def normal_equations(
    J: FloatArray, weight: FloatArray, residuals: FloatArray, point: IntArray, n: int
) -> tuple[FloatArray, FloatArray]:
    """Return J'WJ (n, 3, 3) and J'Wr (n, 3) of each point, for J (2, 3, R), weights (R,) and residuals (R, 2)."""
    weighted = J * weight
    Jr = weighted[0] * residuals[:, 0] + weighted[1] * residuals[:, 1]
    return sum_products(weighted, J, point, n), np.column_stack([np.bincount(point, row, n) for row in Jr])


def huber(chi2: FloatArray, k: float) -> tuple[FloatArray, FloatArray]:
    """Return weights and losses (as GTSAM: half the square within `k`) of squared whitened residuals."""
    r = np.sqrt(chi2)
    inside = r <= k
    weight = np.where(inside, 1.0, k / np.maximum(r, TINY))
    return weight, np.where(inside, chi2 / 2, k * (r - k / 2))


def refine_points(
    K: FloatArray,
    T_submap_kf: FloatArray,
    pose: IntArray,
    xyz_mu: FloatArray,
    point: IntArray,
    uv_px: FloatArray,
    sigma_px: FloatArray,
    robust_k: float,
    steps: int = STEPS,
) -> FloatArray:
    """Return (P, 3) points that fit their views better, robustly; one that would not gain stays where it is.

    - `K` (3, 3), `T_submap_kf` (F, 4, 4), `xyz_mu` (P, 3), `uv_px` (R, 2), `sigma_px` (R,).
    - `pose`, `point` (R,): rows of `T_submap_kf` and `xyz_mu` of each observation.
    - `robust_k`: Huber threshold in sigmas.
    - `steps`: of Gauss-Newton.
    """
    n = len(xyz_mu)
    if n == 0 or len(pose) == 0:
        return xyz_mu
    R = T_submap_kf[pose, :3, :3]
    best = xyz_mu.copy()
    xyz = best
    cost = np.full(n, np.inf)
    for step in range(steps + 1):
        xyz_cam, front, uv = reproject(K, T_submap_kf, pose, xyz.take(point, axis=0))
        safe = np.where(front[:, None], xyz_cam, [0.0, 0.0, 1.0])
        r = uv - uv_px
        r /= sigma_px[:, None]
        weight, loss = huber(np.einsum("ri,ri->r", r, r), robust_k)
        loss[~front] = 1e12
        now = np.bincount(point, loss, n)
        better = (now < cost) & np.isfinite(xyz).all(axis=1)
        best = np.where(better[:, None], xyz, best)
        cost = np.where(better, now, cost)
        if step == steps:
            break
        weight[~front] = 0.0
        J = projection_jacobian(K, R, safe, sigma_px)
        H, b = normal_equations(J, weight, r, point, n)
        H += (DAMPING * np.trace(H, axis1=1, axis2=2) + TINY)[:, None, None] * so3.IDENTITY
        xyz = xyz - np.linalg.solve(H, b[:, :, None])[:, :, 0]
    return best


def refit_points(submap: Submap, robust_k: float, landmark_ids: IntArray) -> FloatArray:
    """Return (N, 3) landmarks that fit all their views in a submap better, as `refine_points` does.

    - `submap`: is not changed.
    - `robust_k`: Huber threshold in sigmas.
    - `landmark_ids` (N,): each once.
    """
    obs, place = submap.observations, np.full(len(submap.landmarks), -1)
    place[landmark_ids] = np.arange(len(landmark_ids))
    rows = np.flatnonzero(obs["alive"] & (place[obs["landmark"]] >= 0))
    ids, pose = np.unique(obs["kf"][rows], return_inverse=True)
    xyz = submap.landmarks["xyz_mu"][landmark_ids]
    T, point, pixels = submap.keyframe_poses(ids), place[obs["landmark"][rows]], submap.observed_pixels(rows)
    return refine_points(submap.K, T, pose, xyz, point, *pixels, robust_k, REFIT_STEPS)
