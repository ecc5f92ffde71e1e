"""A small bundle that poses a new keyframe: numpy, Schur complement, a few milliseconds, and no state.

It is the first of two levels of solving: tracking and mapping continue from it at once. The second level, the submap's
iSAM2 (`dualslam.backend.submap_graph`), takes in the changes later. Free are the newest keyframes and the points that
the newest of all sees; other keyframes that see these points hold them in place.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dualslam.backend.factor_index import INSERT_SIGMAS
from dualslam.backend.noise import LEAST_NOISE, OUTLIER_CHI2, residual_variance
from dualslam.backend.observability import projection_jacobian, reproject
from dualslam.backend.point_refinement import huber, normal_equations
from dualslam.backend.selection import spread_evenly
from dualslam.core.arrays import rank_in_runs, sum_by
from dualslam.core.bundle import BundleProblem
from dualslam.core.estimates import GraphEstimate
from dualslam.core.geometry import se3, so3
from dualslam.core.types import Failure, FailureReason, FloatArray, IntArray
from dualslam.map.submap import Submap

MAX_VIEWS = 8
"""Views of a point that count, spread evenly over its track: they bound the cost, whatever the map's age."""
ITERATIONS = 4
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-7, 1e2
"""Levenberg-Marquardt, relative to the diagonal."""
CONVERGED = 1e-4
"""Relative decrease of the cost below which to stop."""


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    T: FloatArray
    xyz: FloatArray
    xyz_cam: FloatArray
    residuals: FloatArray  # (R, 2), whitened
    weight: FloatArray
    chi2: FloatArray  # infinite behind the camera
    cost: float


class NumpyWindowSolver:
    """The `dualslam.core.interfaces.WindowSolver` in numpy; `robust_k`: Huber threshold in sigmas."""

    def __init__(self, robust_k: float) -> None:
        self._robust_k = robust_k

    def __call__(self, submap: Submap, free_keyframes: list[int]) -> GraphEstimate | Failure:
        """Adjust a few keyframes, but none of the gauge, and the points that the newest sees; return them."""
        start = time.thread_time()
        newest = free_keyframes[0]
        free = [k for k in free_keyframes if k not in submap.gauge and k in submap.keyframes]
        if newest not in free:
            return Failure(FailureReason.SOLVER, f"keyframe {newest} is the gauge's: it does not move")
        ids = submap.landmarks_of_keyframes([newest])
        row, keyframes, window = _window(submap, free, ids)
        if len(keyframes) == len(free):
            return Failure(FailureReason.TOO_FEW_MATCHES, f"nothing but its neighbours holds keyframe {newest}")
        after = adjust_window(window, self._robust_k)
        if not (np.isfinite(after.T).all() and np.isfinite(after.cost)):
            return Failure(FailureReason.SOLVER, "the window has no optimum")
        n_views = np.bincount(window.point, minlength=len(ids))[window.point]
        noise2 = residual_variance(after.chi2, n_views, LEAST_NOISE**2)
        mine = window.kf == 0
        chi2 = np.minimum(after.chi2[mine], INSERT_SIGMAS**2)
        sound = np.isfinite(after.xyz).all(axis=1) & (
            sum_by(window.point, np.isinf(after.chi2)[:, None], len(ids))[:, 0] == 0
        )
        return GraphEstimate(
            keyframe_ids=np.array(free, np.int64),
            T_submap_kf=after.T[: len(free)],
            landmark_ids=ids[sound],
            xyz_mu=after.xyz[sound],
            outlier_rows=np.sort(row[mine & (after.chi2 > OUTLIER_CHI2 * noise2)]),
            chi2_newest=float(chi2.mean() / 2) if len(chi2) else float("nan"),
            noise2=noise2,
            rebuilt=False,
            seconds=time.thread_time() - start,
        )


def _window(submap: Submap, free: list[int], landmark_ids: IntArray) -> tuple[IntArray, IntArray, BundleProblem]:
    """Return the rows that count, their keyframes, and the window, whose free poses come first."""
    obs = submap.observations
    row = submap.rows_of_landmarks(landmark_ids)
    kf, point = obs["kf"][row], np.searchsorted(landmark_ids, obs["landmark"][row])
    is_free = np.isin(kf, free)
    order = np.lexsort((kf, is_free, point))  # the free views of each point last
    row, kf, point, is_free = row[order], kf[order], point[order], is_free[order]
    n_free = np.bincount(point[is_free], minlength=len(landmark_ids))
    n_held = np.bincount(point[~is_free], minlength=len(landmark_ids))
    quota = np.maximum(MAX_VIEWS - n_free, 2)[point]
    kept = is_free | spread_evenly(rank_in_runs(point), n_held[point], quota)
    row, kf, point = row[kept], kf[kept], point[kept]
    keyframes = np.array([*free, *np.setdiff1d(kf, free).tolist()], np.int64)
    by_id = np.argsort(keyframes)
    uv, sigma = submap.observed_pixels(row)
    pose = by_id[np.searchsorted(keyframes[by_id], kf)]
    T, xyz = submap.keyframe_poses(keyframes), submap.landmarks["xyz_mu"][landmark_ids]
    fixed = np.arange(len(keyframes)) >= len(free)
    return row, keyframes, BundleProblem(submap.K, T, fixed, xyz, pose, point, uv, sigma)


def adjust_window(window: BundleProblem, robust_k: float, iterations: int = ITERATIONS) -> _State:
    """Run Levenberg-Marquardt on the free poses and all points, the points eliminated first.

    Poses move by ``T exp(xi)``, xi = (rotation, translation).

    `window`: the free poses come first; observations are sorted by point.
    """
    n_free, n_points = int(np.count_nonzero(~window.fixed)), len(window.xyz_mu)
    mine = np.flatnonzero(window.kf < n_free)
    mine = mine[np.argsort(window.kf[mine], kind="stable")]
    pose, point = window.kf[mine], window.point[mine]
    ends = np.cumsum(2 * np.bincount(pose, minlength=n_free)).tolist()
    views = [slice(*bounds) for bounds in pairwise([0, *ends])]
    state = _evaluate(window, window.T_submap_kf, window.xyz_mu, robust_k)
    damping = FIRST_DAMPING
    for _ in range(iterations):
        safe = np.where(np.isfinite(state.chi2)[:, None], state.xyz_cam, [0.0, 0.0, 1.0])
        R = se3.rotation(state.T.take(window.kf, axis=0))
        J = projection_jacobian(window.K, R, safe, window.sigma_px)
        V, g_point = normal_equations(J, state.weight, state.residuals, window.point, n_points)
        # By the pose: in the camera, a point moves by [p]x omega - v.
        J_point = J[:, :, mine].transpose(2, 0, 1)
        J_cam = J_point @ R[mine]
        J_pose = np.concatenate((J_cam @ so3.hat(safe[mine]), -J_cam), axis=2)
        J_pose_w = J_pose * state.weight[mine, None, None]
        rows, rows_w, residuals = J_pose.reshape(-1, 6), J_pose_w.reshape(-1, 6), state.residuals[mine].ravel()
        U = np.array([rows_w[v].T @ rows[v] for v in views])
        g_pose = np.array([residuals[v] @ rows_w[v] for v in views])
        W = np.zeros((n_points, n_free, 6, 3))
        W[point, pose] = J_pose_w.transpose(0, 2, 1) @ J_point  # a keyframe sees a point once
        moved = _step(state, U, V, W.reshape(n_points, 6 * n_free, 3), g_pose, g_point, damping)
        new = _evaluate(window, *moved, robust_k)
        if new.cost < state.cost:
            gain, state = state.cost - new.cost, new
            damping = max(damping / 10, LEAST_DAMPING)
            if gain < CONVERGED * state.cost:
                break
        else:
            damping = min(damping * 100, MOST_DAMPING)
    return state


def _step(
    state: _State, U: FloatArray, V: FloatArray, W: FloatArray, g_pose: FloatArray, g_point: FloatArray, damping: float
) -> tuple[FloatArray, FloatArray]:
    """Return poses and points moved by one damped step."""
    n_free = len(U)
    V = V + damping * V * np.eye(3) + 1e-9 * (1 + np.trace(V, axis1=1, axis2=2))[:, None, None] * np.eye(3)
    V_inverse = np.linalg.inv(V)
    WV = W @ V_inverse
    S = np.zeros((6 * n_free, 6 * n_free))
    for i in range(n_free):
        S[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = U[i] + damping * U[i] * np.eye(6)
    S -= np.tensordot(WV, W, axes=([0, 2], [0, 2]))
    rhs = -g_pose.ravel() + np.einsum("pij,pj->i", WV, g_point)
    try:
        xi = np.linalg.solve(S + 1e-9 * np.trace(S) * np.eye(len(S)), rhs)
    except np.linalg.LinAlgError:
        return state.T, state.xyz
    dx = -np.einsum("pij,pj->pi", V_inverse, g_point + np.einsum("pji,j->pi", W, xi))
    T = state.T.copy()
    T[:n_free] = T[:n_free] @ se3.exp(xi.reshape(n_free, 6))
    return T, state.xyz + dx


def _evaluate(window: BundleProblem, T: FloatArray, xyz: FloatArray, robust_k: float) -> _State:
    xyz_cam, front, uv_px = reproject(window.K, T, window.kf, xyz.take(window.point, axis=0))
    residuals = uv_px - window.uv_px
    residuals /= window.sigma_px[:, None]
    chi2 = np.einsum("ri,ri->r", residuals, residuals)
    weight, loss = huber(chi2, robust_k)
    return _State(
        T,
        xyz,
        xyz_cam,
        residuals,
        np.where(front, weight, 0.0),
        np.where(front, chi2, np.inf),
        float(np.where(front, loss, huber(np.array([1e6]), robust_k)[1]).sum()),
    )
