"""The covariance of a frame's pose, computed only when it is asked for.

What the submap has seen is linearised at its arrays, but for outliers. The landmarks are eliminated (Schur complement),
the first keyframe and the length of the first baseline are held. The tracker takes landmarks for exact when it poses a
frame. Their errors, and those of the keyframes that place them, are therefore errors of the frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import projection_jacobians
from dualslam.core.interfaces import VisualOdometry
from dualslam.core.noise_model import BASELINE_SIGMA, MIN_LANDMARKS
from dualslam.core.types import FloatArray, IntArray, Track
from dualslam.linking.scale_observability import normal_equations
from dualslam.map.anchors import add_relative_poses
from dualslam.map.submap import NO_LANDMARK, Submap

LOOSE_INFORMATION = 1e-6
"""Of a prior on each pose (rad, units of the submap): where nothing is seen the answer is large, not infinite."""
MIN_EIGENVALUE = 1e-8
"""Of a landmark's covariance, relative to the largest: below, its views do not tell its depth."""


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
        problem = normal_equations(submap, dict.fromkeys(submap.keyframes, 1.0))
        if problem is None:
            return None
        kf, n = problem.ids, len(problem.ids)
        information = problem.reduced + LOOSE_INFORMATION * np.eye(se3.DOF * n)
        blocks = information.reshape(n, se3.DOF, n, se3.DOF)
        add_relative_poses(blocks, kf, submap.T_submap_kf, submap.relative_poses)
        if self.frame in submap.keyframes:
            by_pose = np.zeros((se3.DOF, se3.DOF * n))
            place = se3.DOF * int(np.searchsorted(kf, self.frame))
            by_pose[:, place : place + se3.DOF], own = np.eye(se3.DOF), np.zeros((se3.DOF, se3.DOF))
        else:
            ids, row = np.unique(submap.current_ids(self.landmark_ids), return_index=True)
            spread = np.linalg.eigvalsh(problem.inverse)
            known = np.isin(ids, problem.landmarks[spread[:, 0] > MIN_EIGENVALUE * spread[:, 2]])
            ids, row = ids[known], row[known]
            if len(ids) < MIN_LANDMARKS:
                return None
            T_cam_submap, sigma = se3.inverse(self.T_submap_cam), self.sigma_px[row, None, None]
            J_pose, J_point = projection_jacobians(submap.K, T_cam_submap, submap.landmarks["xyz_mu"][ids])
            J_pose, J_point = J_pose / sigma, J_point / sigma
            pixels = np.linalg.inv(np.einsum("nij,nik->jk", J_pose, J_pose))
            among = np.searchsorted(problem.landmarks, ids)
            by_point = np.zeros((se3.DOF, len(problem.landmarks), 3))
            by_point[:, among] = -np.einsum("ij,nkj,nkl->inl", pixels, J_pose, J_point)
            shared = np.einsum("inj,njk->ink", by_point, problem.inverse).reshape(se3.DOF, -1)
            by_pose, own = -(problem.H_cross @ shared.T).T, pixels + shared @ by_point.reshape(se3.DOF, -1).T
        first, second = _gauge(submap)
        a, b = np.searchsorted(kf, (first, second)).tolist()
        baseline = se3.translation(submap.T_submap_kf[second]) - se3.translation(submap.T_submap_kf[first])
        along = se3.rotation(submap.T_submap_kf[second]).T @ baseline / (baseline @ baseline)
        held = slice(se3.DOF * b + 3, se3.DOF * (b + 1))  # the second's translation
        information[held, held] += np.outer(along, along) / BASELINE_SIGMA**2
        free = np.delete(np.arange(se3.DOF * n), np.arange(se3.DOF * a, se3.DOF * (a + 1)))
        try:
            solved = np.linalg.solve(information[np.ix_(free, free)], by_pose[:, free].T)
        except np.linalg.LinAlgError:
            return None
        covariance = by_pose[:, free] @ solved + own
        return np.asarray((covariance + covariance.T) / 2)


def _gauge(submap: Submap) -> tuple[int, int]:
    """Return the keyframes whose pose, and whose distance from it, are held."""
    first, second = submap.gauge
    oldest = sorted(submap.keyframes)
    first = first if first in submap.keyframes else oldest[0]
    return first, second if second in submap.keyframes else next(k for k in oldest if k != first)
