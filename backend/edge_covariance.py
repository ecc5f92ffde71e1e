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
from dualslam.core.chi_square import huber_weights
from dualslam.core.errors import SolverError
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.noise_model import MIN_DEPTH_MU
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
    n = len(window)
    a, b = np.searchsorted(window, (first, second)).tolist()
    kf, point, x_cam, J_pose, J_point = _linearise(submap, window, robust_k)
    information = np.zeros((n, se3.DOF, n, se3.DOF))
    loose = np.repeat([LOOSE_ROTATION_RAD**-2, LOOSE_TRANSLATION_MU**-2], 3)
    information[np.arange(n), :, np.arange(n), :] = np.diag(loose)
    own = np.zeros((n, se3.DOF, se3.DOF))
    np.add.at(own, kf, J_pose.transpose(0, 2, 1) @ J_pose)
    information[np.arange(n), :, np.arange(n), :] += own
    relative = {k: known for k, known in submap.relative_poses.items() if k not in held}
    add_relative_poses(information, window, submap.T_submap_kf, relative)
    n_points = int(point.max()) + 1 if len(point) else 0
    H_points = np.zeros((n_points, 3, 3))
    np.add.at(H_points, point, J_point.transpose(0, 2, 1) @ J_point)
    cross = np.zeros((n_points, 3, n, se3.DOF))  # one observation of a point in a keyframe at most
    cross[point, :, kf] = J_point.transpose(0, 2, 1) @ J_pose
    flat = cross.reshape(n_points, 3, se3.DOF * n)
    # How a point moves with the poses: dp = moves @ dc.
    moves = np.asarray(-np.linalg.inv(H_points) @ flat, np.float64)
    size = se3.DOF * n
    system = information.reshape(size, size) + flat.reshape(-1, size).T @ moves.reshape(-1, size)
    R = se3.rotation(submap.keyframe_poses(window))
    units = [_unit(c, kf, point, x_cam, R[c], moves, n) for c in (a, b)]
    system += np.outer(units[0], units[0]) / GAUGE_SIGMA**2
    free = np.delete(np.arange(size), np.arange(se3.DOF * a, se3.DOF * (a + 1)))
    read = np.zeros((sim3.DOF, size))
    read[: se3.DOF, se3.DOF * b : se3.DOF * b + se3.DOF] = np.eye(se3.DOF)
    read[-1] = units[1]
    system = (system + system.T)[np.ix_(free, free)] / 2
    try:
        found = read[:, free] @ np.linalg.solve(system, read[:, free].T)
    except np.linalg.LinAlgError as error:
        raise SolverError(f"no covariance between keyframes {first} and {second} of submap {submap.id}") from error
    return np.asarray((found + found.T) / 2, np.float64)


def _linearise(
    submap: Submap, window: IntArray, robust_k: float
) -> tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray]:
    """Linearise the observations of landmarks with two views in the window.

    Returns of each its keyframe's place there, its point, where that stands in the camera, and the whitened
    derivatives by pose (right perturbation) and point.
    """
    rows = submap.rows_of_landmarks(submap.landmarks_of_keyframes(window))
    kf = submap.observations["kf"][rows]
    here = np.isin(kf, window)
    rows, place = rows[here], np.searchsorted(window, kf[here])
    landmark = submap.observations["landmark"][rows]
    T = submap.keyframe_poses(window)
    x = np.einsum("rji,rj->ri", T[place, :3, :3], submap.landmarks["xyz_mu"][landmark] - T[place, :3, 3])
    front = x[:, 2] > MIN_DEPTH_MU
    twice = np.bincount(landmark[front], minlength=len(submap.landmarks)) >= 2
    kept = front & twice[landmark]
    rows, place, landmark, x = rows[kept], place[kept], landmark[kept], x[kept]
    uv, sigma = submap.observed_pixels(rows)
    K, z = submap.K, x[:, 2]
    residual = np.stack(
        ((K[0, 0] * x[:, 0] + K[0, 1] * x[:, 1]) / z + K[0, 2] - uv[:, 0], K[1, 1] * x[:, 1] / z + K[1, 2] - uv[:, 1]),
        1,
    )
    chi2 = (residual**2).sum(axis=1) / sigma**2
    weight = np.sqrt(huber_weights(chi2, robust_k**2)) / sigma
    J = np.zeros((len(x), 2, 3))
    J[:, 0, 0], J[:, 0, 1] = K[0, 0] / z, K[0, 1] / z
    J[:, 0, 2] = -(K[0, 0] * x[:, 0] + K[0, 1] * x[:, 1]) / (z * z)
    J[:, 1, 1], J[:, 1, 2] = K[1, 1] / z, -K[1, 1] * x[:, 1] / (z * z)
    J *= weight[:, None, None]
    J_pose = np.concatenate((J @ so3.hat(x), -J), axis=2)  # T exp(xi) takes the point to x + hat(x) w - u
    _, point = np.unique(landmark, return_inverse=True)
    H = np.zeros((int(point.max()) + 1 if len(point) else 0, 3, 3))
    J_point = J @ T[place, :3, :3].transpose(0, 2, 1)
    np.add.at(H, point, J_point.transpose(0, 2, 1) @ J_point)
    # Points that hardly have a depth are left out: their share of the matrix would be noise.
    spread = np.linalg.eigvalsh(H)
    certain = (spread[:, 0] > 1e-10 * spread[:, -1])[point] if len(H) else np.zeros(0, bool)
    _, point = np.unique(point[certain], return_inverse=True)
    return place[certain], point, x[certain], J_pose[certain], J_point[certain]


def _unit(
    c: int, kf: IntArray, point: IntArray, x_cam: FloatArray, R: FloatArray, moves: FloatArray, n: int
) -> FloatArray:
    """Return the derivative (6 n,) of the mean log-depth of what keyframe `c` of the window sees, by all poses."""
    seen = np.flatnonzero(kf == c)
    derivative = np.zeros(se3.DOF * n)
    if not len(seen):
        return derivative
    x = x_cam[seen]
    derivative += (np.einsum("r,i,rij->j", 1 / x[:, 2], R[:, 2], moves[point[seen]])) / len(seen)
    own = np.concatenate((so3.hat(x)[:, 2], np.broadcast_to([0.0, 0.0, -1.0], x.shape)), axis=1)
    derivative[se3.DOF * c : se3.DOF * c + se3.DOF] += (own / x[:, 2:]).mean(0)
    return derivative
