"""Uncertainty of a pose found across a gap: its covariance, and how well it holds the scale.

All that is mapped beyond the gap inherits the scale at which a frame there sees points of the other side. What that is
worth is read from the Hessian, in which pose and points are unknown together.
"""

from __future__ import annotations

import numpy as np

from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import projection_jacobians
from dualslam.core.noise_model import MIN_LANDMARKS, TINY
from dualslam.core.types import Failure, FailureReason, FloatArray, IntArray, Track
from dualslam.map.landmark_views import landmark_covariances
from dualslam.map.submap import Submap

HESSIAN_INFLATION = 1.5
"""Of standard deviations: the poses that fix the points have errors too, and pixels of neighbours err alike."""
SMALL_STEP = 0.1
"""Of the median depth: a scale that is off by a quarter then moves what lies beyond by 2.5 %."""


def gap_uncertainty(
    K: FloatArray, T_cam_submap: FloatArray, xyz: FloatArray, sigma_px: FloatArray, information: FloatArray
) -> tuple[FloatArray, float]:
    """Return the covariance of a pose (6, 6), and the standard deviation of the points' mean log depth there.

    - `K` (3, 3), `T_cam_submap` (4, 4).
    - `xyz` (N, 3): points that the camera sees.
    - `sigma_px` (N,): noise of their pixels.
    - `information` (N, 3, 3): what is known of the points without this camera: inverse covariances, which need not be
      of full rank.
    """
    n = len(xyz)
    J_pose, J_point = projection_jacobians(K, T_cam_submap, xyz)
    weight = (1.0 / sigma_px**2)[:, None, None]
    H_points = information + J_point.swapaxes(1, 2) @ (weight * J_point)
    H_pose = (J_pose.swapaxes(1, 2) @ (weight * J_pose)).sum(axis=0)
    H_cross = J_pose.swapaxes(1, 2) @ (weight * J_point)
    inverse = np.linalg.pinv(H_points, hermitian=True)
    p = xyz @ se3.rotation(T_cam_submap).T + se3.translation(T_cam_submap)
    g_pose = np.column_stack([p[:, 1], -p[:, 0], np.zeros((n, 3)), np.ones(n)]) / p[:, 2:]
    g_point = T_cam_submap[2, :3] / p[:, 2:]
    # A point counts by how well its own depth is known where the poses are.
    share = 1.0 / np.maximum(np.einsum("ni,nij,nj->n", g_point, inverse, g_point), TINY)
    share /= share.sum()
    g_pose_mean, g_point = share @ g_pose, share[:, None] * g_point
    reduced = H_pose - (H_cross @ inverse @ H_cross.swapaxes(1, 2)).sum(axis=0)
    rest = g_pose_mean - np.einsum("nij,njk,nk->i", H_cross, inverse, g_point)
    covariance = np.linalg.pinv(reduced, hermitian=True)
    variance = np.einsum("ni,nij,nj->", g_point, inverse, g_point) + rest @ covariance @ rest
    return HESSIAN_INFLATION**2 * covariance, HESSIAN_INFLATION * float(np.sqrt(max(variance, 0.0)))


def pose_uncertainty(
    submap: Submap, T_cam_submap: FloatArray, landmark_ids: IntArray, sigma_px: FloatArray
) -> tuple[FloatArray, float] | None:
    """Return the same of a pose that was found by a submap's landmarks; None where these are too few to tell.

    Tracking takes landmarks for exact, which is good enough from one frame to the next.

    - `T_cam_submap` (4, 4), `sigma_px` (N,).
    - `landmark_ids` (N,): those that agree with the pose, each once.
    """
    covariances = landmark_covariances(submap, landmark_ids)
    known = np.isfinite(covariances).all(axis=(1, 2)) & (submap.depths(landmark_ids, T_cam_submap) > 0)
    if np.count_nonzero(known) < MIN_LANDMARKS:
        return None
    xyz = submap.landmarks["xyz_mu"][landmark_ids[known]]
    information = np.asarray(np.linalg.inv(covariances[known]), np.float64)
    return gap_uncertainty(submap.K, T_cam_submap, xyz, sigma_px[known], information)


def track_uncertainty(submap: Submap, track: Track) -> tuple[FloatArray, float] | None:
    """Return the same of a track by the landmarks that it sees; None where these are too few to tell."""
    row = np.flatnonzero(track.landmark_ids >= 0)
    sigma_px = track.view.features.sigma_px[row]
    return pose_uncertainty(submap, track.T_cam_submap, track.landmark_ids[row], sigma_px)


def refuse_lost_scale(submap: Submap, track: Track, last: Track, max_scale_sigma: float) -> Failure | None:
    """Refuse a track across a gap that does not hold the scale, which all that is mapped beyond the gap will inherit.

    A step from the last track that is small against the depth of what is seen leaves the scale where it is.
    """
    ids = track.seen_ids
    step = se3.translation(se3.inverse(track.T_cam_submap)) - se3.translation(se3.inverse(last.T_cam_submap))
    if np.linalg.norm(step) < SMALL_STEP * np.median(submap.depths(ids, track.T_cam_submap)):
        return None
    known = track_uncertainty(submap, track)
    scale_sigma = np.inf if known is None else known[1]
    if scale_sigma <= max_scale_sigma:
        return None
    detail = f"the scale beyond the gap is known to {scale_sigma:.1%}"
    return Failure(FailureReason.SCALE, detail, {"gap_scale_sigma": scale_sigma})
