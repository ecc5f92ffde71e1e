"""How well a submap's own factors know the similarity between two of its keyframes, without opening its graph.

The graph of an archived submap is gone, and iSAM2 tells marginals of single poses against the gauge only, without a
scale. Therefore the same projection factors are linearised here at the values in the arrays, for the keyframes between
the two and a few beside them. Their landmarks are eliminated (Schur complement), and pose and unit of length of the
first keyframe are held. What is left is the covariance of the second keyframe's pose and unit. The unit at a keyframe
is the mean logarithm of the depths of what it sees.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dualslam.backend.noise import GAUGE_SIGMA
from dualslam.backend.observability import compute_residuals
from dualslam.core.chi_square import huber_weights
from dualslam.core.errors import SolverError
from dualslam.core.geometry import se3, sim3
from dualslam.core.geometry.normal_equations import NormalEquations, eliminate_points
from dualslam.core.types import FloatArray, IntArray
from dualslam.map.anchors import add_relative_poses
from dualslam.map.submap import Submap

BESIDE = 3
"""Keyframes beyond either end that are looked at: what the ends see of the way between hangs on them too."""
LONGEST = 24
"""Of more keyframes between two ends only those near the ends are looked at (an edge across what both of them see)."""
LOOSE_ROTATION_RAD, LOOSE_TRANSLATION_MU = 0.3, 1.0
"""Sigmas of a prior on each pose of the window: where its factors say nothing the answer is large, and not infinite."""


def edge_covariances(
    submap: Submap, pairs: Sequence[tuple[int, int]], robust_k: float, held: frozenset[int] = frozenset()
) -> FloatArray:
    """Return the covariances of similarities between keyframes of a submap.

    - `pairs` (sequence of (int, int)): keyframe ids.
    - `robust_k`: Huber threshold in sigmas.
    - `held`: keyframes whose relative pose is no evidence.

    Returns (E, 7, 7): of the right perturbation of ``S_first_second``: rotation, translation, log-scale, in the second
    keyframe's frame and the submap's unit.

    Raises `SolverError` if a keyframe is not in the submap, or the answer is not finite.
    """
    for k in {k for pair in pairs for k in pair}:
        if k not in submap.keyframes:
            raise SolverError(f"keyframe {k} is not in submap {submap.id}: no covariance of an edge to it")
    ids = np.array(sorted(submap.keyframes), np.int64)
    covariances = np.array([_covariance(submap, ids, *pair, robust_k, held) for pair in pairs]).reshape(
        -1, sim3.DOF, sim3.DOF
    )
    if not np.isfinite(covariances).all():
        raise SolverError(f"submap {submap.id}: its factors give no covariance of some edges between keyframes")
    return covariances


def _window(ids: IntArray, first: int, second: int) -> IntArray:
    a, b = sorted(np.searchsorted(ids, (first, second)).tolist())
    if b - a <= LONGEST:
        return ids[max(a - BESIDE, 0) : b + BESIDE + 1]
    ends = [ids[max(i - BESIDE, 0) : i + BESIDE + 1] for i in (a, b)]
    return np.asarray(np.union1d(*ends), np.int64)


def _covariance(
    submap: Submap, ids: IntArray, first: int, second: int, robust_k: float, held: frozenset[int]
) -> FloatArray:
    window = _window(ids, first, second)
    n, size = len(window), se3.DOF * len(window)
    a, b = np.searchsorted(window, (first, second)).tolist()
    equations = _linearise(submap, window, robust_k)
    loose = np.repeat([LOOSE_ROTATION_RAD**-2, LOOSE_TRANSLATION_MU**-2], 3)
    information = (equations.reduced + np.diag(np.tile(loose, n))).reshape(n, se3.DOF, n, se3.DOF)
    relative = {k: known for k, known in submap.relative_poses.items() if k not in held}
    add_relative_poses(information, window, submap.T_submap_kf, relative)
    system = information.reshape(size, size)
    seen = [equations.log_depth(np.array([place]), evenly=True) for place in (a, b)]
    units = [np.zeros(size) if each is None else equations.by_poses(*each) for each in seen]
    system += np.outer(units[0], units[0]) / GAUGE_SIGMA**2
    free = np.delete(np.arange(size), np.arange(se3.DOF * a, se3.DOF * (a + 1)))
    read = np.zeros((sim3.DOF, size))
    read[: se3.DOF, se3.DOF * b : se3.DOF * b + se3.DOF] = -np.eye(se3.DOF)  # exp(xi) T_cam is T exp(-xi)
    read[-1] = units[1]
    try:
        found = read[:, free] @ np.linalg.solve(system[np.ix_(free, free)], read[:, free].T)
    except np.linalg.LinAlgError as error:
        raise SolverError(f"no covariance between keyframes {first} and {second} of submap {submap.id}") from error
    return np.asarray((found + found.T) / 2, np.float64)


def _linearise(submap: Submap, window: IntArray, robust_k: float) -> NormalEquations:
    """Return the normal equations of the window's keyframes and of the landmarks with two views in it."""
    rows = submap.rows_of_landmarks(submap.landmarks_of_keyframes(window))
    rows = rows[np.isin(submap.observations["kf"][rows], window)]
    kf, landmark = np.searchsorted(window, submap.observations["kf"][rows]), submap.observations["landmark"][rows]
    T, (uv, sigma) = submap.keyframe_poses(window), submap.observed_pixels(rows)
    chi2 = compute_residuals(submap.K, T, kf, submap.landmarks["xyz_mu"][landmark], uv, sigma).chi2
    front = np.isfinite(chi2)
    kept = front & (np.bincount(landmark[front], minlength=len(submap.landmarks)) >= 2)[landmark]
    landmarks, point = np.unique(landmark[kept], return_inverse=True)
    sigma = sigma[kept] / np.sqrt(huber_weights(chi2[kept], robust_k**2))
    return eliminate_points(submap.K, se3.inverse(T), submap.landmarks["xyz_mu"][landmarks], kf[kept], point, sigma)
