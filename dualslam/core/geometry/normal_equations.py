"""Normal equations of poses and points in one map, the points eliminated, without solving them.

They say how firmly a map holds its shape. Poses move by ``exp(xi) @ T_cam_map``, rotation first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from dualslam.core.arrays import sum_by
from dualslam.core.geometry import se3, so3
from dualslam.core.noise_model import TINY
from dualslam.core.types import FloatArray, IntArray

SLACK = 1e-12
"""Relative to a block of the normal equations: what keeps a point without parallax from being singular."""


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """The normal equations of F poses and N points, the points' blocks inverted."""

    T_cam_map: FloatArray  # (F, 4, 4)
    xyz: FloatArray  # (N, 3)
    # Rows of each observation.
    kf: IntArray  # (R,)
    point: IntArray  # (R,)
    inverse: FloatArray  # (N, 3, 3): covariances of the points, given the poses
    H_cross: sparse.bsr_array  # (6 F, 3 N) sparse
    reduced: FloatArray  # (6 F, 6 F): of the poses, the points eliminated

    def log_depth(self, poses: IntArray, evenly: bool = False) -> tuple[FloatArray, FloatArray] | None:
        """Return the derivative of the mean log depth that some poses see: by the poses (6 F,), the points (N, 3).

        A point counts by how well its own depth is known where the poses are, or all count `evenly`. None where they
        see nothing.
        """
        seen = np.isin(self.kf, poses)
        if not seen.any():
            return None
        kf, point = self.kf[seen], self.point[seen]
        T = self.T_cam_map[kf]
        p = se3.act_each(T, self.xyz[point])
        by_pose = np.column_stack([p[:, 1], -p[:, 0], np.zeros((len(p), 3)), np.ones(len(p))]) / p[:, 2:]
        by_point = T[:, 2, :3] / p[:, 2:]
        variance = np.einsum("ri,rij,rj->r", by_point, self.inverse[point], by_point)
        share = np.ones(len(p)) if evenly else 1.0 / np.maximum(variance, TINY)
        share /= share.sum()
        g_pose = sum_by(kf, share[:, None] * by_pose, len(self.T_cam_map))
        g_point = sum_by(point, share[:, None] * by_point, len(self.xyz))
        return g_pose.reshape(-1), g_point

    def by_poses(self, g_pose: FloatArray, g_point: FloatArray) -> FloatArray:
        """Return a functional's derivative by the poses (6 F,) when the points follow them."""
        follows = np.einsum("nij,nj->ni", self.inverse, g_point)
        return np.asarray(g_pose - self.H_cross @ follows.reshape(-1), np.float64)


def eliminate_points(
    K: FloatArray,
    T_cam_map: FloatArray,
    xyz: FloatArray,
    kf: IntArray,
    point: IntArray,
    sigma_px: FloatArray,
    known: FloatArray | float = 0.0,
) -> NormalEquations:
    """Return the normal equations of R observations.

    - `K` (3, 3), `T_cam_map` (F, 4, 4), `xyz` (N, 3).
    - `kf`, `point` (R,): rows of poses and points of each observation, in front of its camera; each point is seen.
    - `sigma_px` (R,).
    - `known` (N, 3, 3): what is known of the points besides: inverse covariances, which need not be of full rank.
    """
    order = np.lexsort((point, kf))  # as the blocks of a sparse matrix are stored
    kf, point, sigma_px = kf[order], point[order], sigma_px[order]
    n_f, n_p, T = len(T_cam_map), len(xyz), T_cam_map[kf]
    p = se3.act_each(T, xyz[point])
    x, y, z = p.T
    J = np.zeros((len(p), 2, 3))  # by the point in the camera
    J[:, 0, 0], J[:, 0, 2] = K[0, 0] / z, -K[0, 0] * x / z**2
    J[:, 1, 1], J[:, 1, 2] = K[1, 1] / z, -K[1, 1] * y / z**2
    J /= sigma_px[:, None, None]
    J_pose, J_point = np.concatenate((-J @ so3.hat(p), J), axis=2), J @ se3.rotation(T)
    by_pose = J_pose.transpose(0, 2, 1)
    H_point = known + sum_by(point, J_point.transpose(0, 2, 1) @ J_point, n_p)
    H_point += SLACK * np.trace(H_point, axis1=1, axis2=2)[:, None, None] * so3.IDENTITY
    inverse = np.asarray(np.linalg.inv(H_point), np.float64)
    H_pose, blocks = sum_by(kf, by_pose @ J_pose, n_f), by_pose @ J_point
    start = np.concatenate([[0], np.cumsum(np.bincount(kf, minlength=n_f))])
    H_cross, through = (
        sparse.bsr_array((values, point, start), shape=(6 * n_f, 3 * n_p))
        for values in (blocks, blocks @ inverse[point])
    )
    reduced = -np.asarray((through @ H_cross.T).toarray())
    for f in range(n_f):
        reduced[6 * f : 6 * f + 6, 6 * f : 6 * f + 6] += H_pose[f]
    return NormalEquations(T_cam_map, xyz, kf, point, inverse, H_cross, (reduced + reduced.T) / 2)
