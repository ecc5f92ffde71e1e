"""A small bundle that poses a new keyframe: some milliseconds, and no state.

It is the first of two levels of solving: tracking and mapping continue from it at once. The second level, the submap's
iSAM2 (`dualslam.backend.submap_graph`), takes in the changes later. Free are the newest keyframes and the points that
the newest of all sees; other keyframes that see these points hold them in place.
"""

from __future__ import annotations

import time
from functools import partial

import numpy as np

from dualslam.backend.factor_index import INSERT_SIGMAS
from dualslam.backend.noise import LEAST_NOISE, OUTLIER_CHI2, residual_variance
from dualslam.backend.observability import compute_residuals
from dualslam.backend.point_refinement import huber
from dualslam.backend.schur import optimise
from dualslam.backend.selection import spread_evenly
from dualslam.core.arrays import rank_in_runs
from dualslam.core.bundle import BundleProblem
from dualslam.core.errors import SolverError
from dualslam.core.estimates import GraphEstimate
from dualslam.core.types import Failure, FailureReason, IntArray
from dualslam.map.submap import Submap

MAX_VIEWS = 8
"""Views of a point that count, spread evenly over its track: they bound the cost, whatever the map's age."""
ITERATIONS = 4
CONVERGED = 1e-4
"""Relative decrease of the cost below which to stop."""


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
        try:
            after = optimise(window, partial(huber, k=self._robust_k), ITERATIONS, CONVERGED).state
        except SolverError as error:
            return Failure(FailureReason.SOLVER, str(error))
        T, xyz, point = after.T_submap_kf, after.xyz_mu, window.point
        all_chi2 = compute_residuals(window.K, T, window.kf, xyz[point], window.uv_px, window.sigma_px).chi2
        n_views = np.bincount(point, minlength=len(ids))[point]
        noise2 = residual_variance(all_chi2, n_views, LEAST_NOISE**2)
        mine = window.kf == 0
        chi2 = np.minimum(all_chi2[mine], INSERT_SIGMAS**2)
        sound = np.bincount(point, np.isinf(all_chi2), len(ids)) == 0
        return GraphEstimate(
            keyframe_ids=np.array(free, np.int64),
            T_submap_kf=T[: len(free)],
            landmark_ids=ids[sound],
            xyz_mu=xyz[sound],
            outlier_rows=np.sort(row[mine & (all_chi2 > OUTLIER_CHI2 * noise2)]),
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
