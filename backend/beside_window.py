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
from dualslam.core.types import BoolArray, IntArray
from dualslam.map.submap import Submap

N_FREE, N_FIXED = 3, 8
"""Keyframes that are adjusted, and others that hold them: those that see most of the same points."""
N_ITERATIONS = 3
MIN_JUDGED_VIEWS = 3
"""Two views fit almost any pair of poses: their residuals say nothing."""


def adjust_window(submap: Submap, config: GraphConfig) -> GraphEstimate:
    """Adjust the newest keyframes of a submap; the submap is not changed.

    The gauge's keyframes stay where they are. Where the solver fails, everything does.

    Parameters
    ----------
    submap : Submap
    config : GraphConfig

    Returns
    -------
    GraphEstimate
        Of the keyframes and landmarks that were adjusted.
    """
    start = time.thread_time()
    free = [k for k in list(submap.keyframes)[-N_FREE:] if k not in submap.gauge]
    landmarks = submap.landmarks_of_keyframes(free)
    if not free or not len(landmarks):
        return _nothing(start)
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
    except SolverError:
        return _nothing(start)
    n_views = np.bincount(point, minlength=len(landmarks))[point]
    noise2 = residual_variance(found.chi2, n_views, config.least_noise**2)
    judged: BoolArray = (n_views >= MIN_JUDGED_VIEWS) & (kf == free[-1])
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


def _nothing(start: float) -> GraphEstimate:
    none, nan = np.zeros(0, np.int64), float("nan")
    seconds = time.thread_time() - start
    return GraphEstimate(none, np.zeros((0, 4, 4)), none, np.zeros((0, 3)), none, nan, 1.0, False, seconds)
