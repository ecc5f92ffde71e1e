"""The window that serves tracking while the submap's graph is solved in another process.

The newest keyframes and the points that they see are adjusted in batch, everything else stays: the window hangs on the
older keyframes that see the same points, and on the graph's last estimate of them.
"""

from __future__ import annotations

import time

import numpy as np

from dualslam.backend.local_ba import bundle_adjust_arrays
from dualslam.backend.noise import residual_variance
from dualslam.config.settings import GraphConfig
from dualslam.core.bundle import BundleProblem
from dualslam.core.errors import SolverError
from dualslam.core.interfaces import GraphEstimate
from dualslam.core.types import BoolArray, Failure, FailureReason, IntArray
from dualslam.map.submap import Submap

N_FIXED = 8
"""Keyframes that hold those that are adjusted: those that see most of the same points."""
N_ITERATIONS = 3
MIN_JUDGED_VIEWS = 3
"""Two views fit almost any pair of poses: their residuals say nothing."""


def adjust_window(submap: Submap, keyframe_ids: list[int], config: GraphConfig) -> GraphEstimate | Failure:
    """Adjust some keyframes of a submap; the submap is not changed.

    Parameters
    ----------
    submap : Submap
    keyframe_ids : list of int
        The newest first. Those of the gauge stay where they are.
    config : GraphConfig

    Returns
    -------
    GraphEstimate or Failure
        Of the keyframes and landmarks that were adjusted.
    """
    start = time.thread_time()
    free = [k for k in keyframe_ids if k not in submap.gauge]
    landmarks = submap.landmarks_of_keyframes(free)
    if not free or not len(landmarks):
        return Failure(FailureReason.TOO_FEW_MATCHES, "nothing to adjust")
    others, _ = submap.covisible(landmarks)
    fixed = [k for k in others.tolist() if k not in free][:N_FIXED]
    keyframes = np.array([*free, *fixed], np.int64)
    rows = submap.rows_of_landmarks(landmarks)
    kf = submap.observations["kf"][rows]
    inside = np.isin(kf, keyframes)
    rows, kf = rows[inside], kf[inside]
    place = np.full(int(keyframes.max()) + 1, -1, np.int64)
    place[keyframes] = np.arange(len(keyframes))
    point = np.searchsorted(landmarks, submap.observations["landmark"][rows])
    uv, sigma = submap.observed_pixels(rows)
    problem = BundleProblem(
        submap.K,
        submap.keyframe_poses(keyframes),
        np.arange(len(keyframes)) >= len(free),
        submap.landmarks["xyz_mu"][landmarks],
        place[kf],
        point,
        uv,
        sigma,
    )
    try:
        found = bundle_adjust_arrays(problem, config.robust_k, N_ITERATIONS)
    except SolverError as error:
        return Failure(FailureReason.SOLVER, str(error))
    n_views = np.bincount(point, minlength=len(landmarks))[point]
    noise2 = residual_variance(found.chi2, n_views, config.least_noise**2)
    judged: BoolArray = (n_views >= MIN_JUDGED_VIEWS) & (kf == free[0])
    outliers: IntArray = rows[judged & (found.chi2 > config.outlier_chi2 * noise2)]
    newest = found.chi2[judged]
    chi2 = float(np.minimum(newest, config.insert_sigmas**2).mean() / 2) if len(newest) else float("nan")
    adjusted = found.adjusted
    return GraphEstimate(
        keyframe_ids=np.array(free, np.int64),
        T_submap_kf=found.T_submap_kf[: len(free)],
        landmark_ids=landmarks[adjusted],
        xyz_mu=found.xyz_mu[adjusted],
        outlier_rows=outliers,
        chi2_newest=chi2,
        noise2=noise2,
        rebuilt=False,
        seconds=time.thread_time() - start,
    )
