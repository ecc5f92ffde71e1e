"""The covariance of a frame's pose, computed only when it is asked for.

All observations of the submap are linearised at its arrays. The landmarks are eliminated (Schur complement), the first
keyframe and the length of the first baseline are held. The tracker takes landmarks for exact when it poses a frame.
Their errors, and those of the keyframes that place them, are therefore errors of the frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.sparse import bsr_array

from dualslam.core.arrays import sum_by
from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import projection_jacobians
from dualslam.core.interfaces import VisualOdometry
from dualslam.core.noise_model import BASELINE_SIGMA, MIN_LANDMARKS
from dualslam.core.types import FloatArray, IntArray, Track
from dualslam.map.submap import NO_LANDMARK, Submap

LOOSE_INFORMATION = 1e-6
"""Of a prior on each pose (rad, units of the submap): where nothing is seen the answer is large, not infinite."""
MIN_EIGENVALUE = 1e-8
"""Of a landmark's information, relative to the largest: below, its views do not tell its depth."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseCovariance:
    """What is needed to tell how sure a frame's pose is."""

    submap: Submap
    frame: int
    T_submap_cam: FloatArray  # (4, 4)
    landmark_ids: IntArray  # (N,): that the frame agrees with
    sigma_px: FloatArray  # (N,): of the pixels at which it sees them

    @classmethod
    def of(cls, live: VisualOdometry, track: Track, T_submap_cam: FloatArray) -> Self:
        """Keep what is needed of a track in the live submap."""
        seen = np.flatnonzero(track.landmark_ids != NO_LANDMARK)
        ids, sigma = track.landmark_ids[seen], track.view.features.sigma_px[seen]
        return cls(live.submap, track.view.index, T_submap_cam, ids, sigma)

    def __call__(self) -> FloatArray | None:
        """Return the covariance (6, 6); None where the landmarks do not fix the pose."""
        submap = self.submap
        kf = np.array(sorted(submap.keyframes), np.int64)
        points, ties, information = _without_landmarks(submap, kf)
        if self.frame in submap.keyframes:
            by_pose = np.zeros((se3.DOF, se3.DOF * len(kf)))
            place = se3.DOF * int(np.searchsorted(kf, self.frame))
            by_pose[:, place : place + se3.DOF], own = np.eye(se3.DOF), np.zeros((se3.DOF, se3.DOF))
        else:
            ids, row = np.unique(submap.current_ids(self.landmark_ids), return_index=True)
            known = np.isin(ids, points.ids)
            ids, row = ids[known], row[known]
            if len(ids) < MIN_LANDMARKS:
                return None
            T_cam_submap, sigma = se3.inverse(self.T_submap_cam), self.sigma_px[row, None, None]
            J_pose, J_point = projection_jacobians(submap.K, T_cam_submap, submap.landmarks["xyz_mu"][ids])
            J_pose, J_point = J_pose / sigma, J_point / sigma
            pixels = np.linalg.inv(np.einsum("nij,nik->jk", J_pose, J_pose))
            among = np.searchsorted(points.ids, ids)
            by_root = np.zeros((se3.DOF, len(points.ids), 3))
            by_root[:, among] = -np.einsum("ij,nkj,nkl->inl", pixels, J_pose, J_point @ points.root[among])
            flat = by_root.reshape(se3.DOF, -1)
            by_pose, own = -(ties @ flat.T).T, pixels + flat @ flat.T
        first, second = _gauge(submap)
        a, b = np.searchsorted(kf, (first, second)).tolist()
        baseline = se3.translation(submap.T_submap_kf[second]) - se3.translation(submap.T_submap_kf[first])
        along = se3.rotation(submap.T_submap_kf[second]).T @ baseline / (baseline @ baseline)
        held = slice(se3.DOF * b + 3, se3.DOF * (b + 1))  # the second's translation
        information[held, held] += np.outer(along, along) / BASELINE_SIGMA**2
        free = np.delete(np.arange(se3.DOF * len(kf)), np.arange(se3.DOF * a, se3.DOF * (a + 1)))
        try:
            solved = np.linalg.solve(information[np.ix_(free, free)], by_pose[:, free].T)
        except np.linalg.LinAlgError:
            return None
        covariance = by_pose[:, free] @ solved + own
        return np.asarray((covariance + covariance.T) / 2)


@dataclass(frozen=True, slots=True, eq=False)
class _Points:
    """Landmarks whose views fix them."""

    ids: IntArray  # (P,): ascending
    root: FloatArray  # (P, 3, 3): a root of their covariances, the poses held


def _gauge(submap: Submap) -> tuple[int, int]:
    """Return the keyframes whose pose, and whose distance from it, are held."""
    first, second = submap.gauge
    oldest = sorted(submap.keyframes)
    first = first if first in submap.keyframes else oldest[0]
    return first, second if second in submap.keyframes else next(k for k in oldest if k != first)


def _without_landmarks(submap: Submap, kf: IntArray) -> tuple[_Points, bsr_array, FloatArray]:
    """Return landmarks, their ties to the poses (6 n, 3 P) and the information (6 n, 6 n) of the poses without them."""
    rows = submap.rows_of_landmarks(np.flatnonzero(submap.landmarks["alive"]))
    landmark, pose = submap.observations["landmark"][rows], np.searchsorted(kf, submap.observations["kf"][rows])
    _, sigma = submap.observed_pixels(rows)
    T = se3.inverse(submap.keyframe_poses(kf))[pose]
    p = np.einsum("rij,rj->ri", se3.rotation(T), submap.landmarks["xyz_mu"][landmark]) + se3.translation(T)
    front = p[:, 2] > 0
    landmark, pose, sigma, T, p = landmark[front], pose[front], sigma[front, None, None], T[front], p[front]
    J_pose, J_cam = projection_jacobians(submap.K, se3.IDENTITY, p)
    J_pose, J_point = J_pose / sigma, J_cam @ se3.rotation(T) / sigma
    ids, point = np.unique(landmark, return_inverse=True)
    V = sum_by(point, J_point.transpose(0, 2, 1) @ J_point, len(ids))
    spread = np.linalg.eigvalsh(V)
    certain = spread[:, 0] > MIN_EIGENVALUE * spread[:, 2]
    kept = certain[point]
    pose, J_pose, J_point = pose[kept], J_pose[kept], J_point[kept]
    point = (np.cumsum(certain) - 1)[point[kept]]
    root = np.linalg.cholesky(np.linalg.inv(V[certain]))
    order = np.lexsort((point, pose))
    pose, point, J_pose, J_point = pose[order], point[order], J_pose[order], J_point[order]
    n = len(kf)
    tie = J_pose.transpose(0, 2, 1) @ J_point @ root[point]
    ends = np.searchsorted(pose, np.arange(n + 1))
    ties = bsr_array((tie, point, ends), shape=(se3.DOF * n, 3 * len(root)))
    information = -(ties @ ties.T).toarray() + LOOSE_INFORMATION * np.eye(se3.DOF * n)
    blocks = information.reshape(n, se3.DOF, n, se3.DOF)
    blocks[np.arange(n), :, np.arange(n)] += sum_by(pose, J_pose.transpose(0, 2, 1) @ J_pose, n)
    place = {k: i for i, k in enumerate(kf.tolist())}
    for k, known in submap.relative_poses.items():
        if k in place and known.keyframe_id in place:
            i, j = place[known.keyframe_id], place[k]
            W = np.linalg.inv(known.covariance)
            Ad = se3.adjoint(se3.inverse(submap.T_submap_kf[k]) @ submap.T_submap_kf[known.keyframe_id])
            blocks[j, :, j] += W
            blocks[i, :, i] += Ad.T @ W @ Ad
            blocks[i, :, j] -= Ad.T @ W
            blocks[j, :, i] -= W @ Ad
    return _Points(ids[certain], root), ties, information
