"""The pose of a frame whose landmarks are as uncertain as the views that placed them leave them.

A pose found against landmarks that are taken for exact comes out too short, as in a regression on noisy data. A gate in
the pixels' own noise then keeps what agrees with it. Both shrink a young map.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dualslam.core.chi_square import CHI2_95
from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import PoseEstimate, project_points, projection_jacobians
from dualslam.core.geometry.triangulation import point_covariance
from dualslam.core.types import BoolArray, FloatArray, IntArray
from dualslam.map.submap import Submap

STEPS = 2
"""Gauss-Newton steps of pose and landmarks together, from the pose against exact landmarks."""


def refine_with_landmarks(
    submap: Submap,
    landmark_ids: IntArray,
    found: PoseEstimate,
    uv_px: FloatArray,
    sigma_px: FloatArray,
    counted: BoolArray,
) -> PoseEstimate:
    """Refine a frame's pose together with the landmarks that it sees; these stay in the submap as they are.

    - `landmark_ids` (N,): each once.
    - `found`: the pose against exact landmarks. Its covariance is kept.
    - `uv_px` (N, 2), `sigma_px` (N,): pixels of the landmarks.
    - `counted` (N,) bool: landmarks that the pose is estimated from.

    Returns PoseEstimate: `chi2` and `inliers` by the noise of pixels and landmarks together. It is `found` where fewer
    landmarks agree.
    """
    front = np.flatnonzero(np.isfinite(found.chi2))
    ids, uv_px, counted = landmark_ids[front], uv_px[front], counted[front]
    xyz = known = submap.landmarks["xyz_mu"].take(ids, axis=0)
    placed, T = _covariances(submap, ids, known), found.T_cam_w
    pixel = (sigma_px[front] ** 2)[:, None, None] * np.eye(2)
    for step in range(STEPS + 1):
        uv, _ = project_points(submap.K, T, xyz)  # NaN behind the camera: such a landmark agrees with no pose
        J_pose, J_point = projection_jacobians(submap.K, T, xyz)
        residual = uv_px - uv + (J_point @ (xyz - known)[:, :, None])[:, :, 0]
        gain = placed @ J_point.transpose(0, 2, 1)
        weight = np.linalg.inv(J_point @ gain + pixel)
        whitened = (weight @ residual[:, :, None])[:, :, 0]
        chi2 = (residual * whitened).sum(axis=1)
        agrees = chi2 < CHI2_95[2]
        n_inliers = int(np.count_nonzero(agrees))
        if n_inliers < found.n_inliers or step == STEPS:
            break
        used, J_white = agrees & counted, weight @ J_pose
        J = J_pose[used].reshape(-1, 6)
        xi = np.linalg.solve(J_white[used].reshape(-1, 6).T @ J, whitened[used].ravel() @ J)
        T = se3.exp(xi) @ T
        xyz = known + (gain @ (whitened - J_white @ xi)[:, :, None])[:, :, 0]
    if n_inliers < found.n_inliers:
        return found
    all_chi2, inliers = np.full(len(landmark_ids), np.inf), np.zeros(len(landmark_ids), np.bool_)
    all_chi2[front], inliers[front] = np.nan_to_num(chi2, nan=np.inf), agrees
    return replace(found, T_cam_w=T, inliers=inliers, chi2=all_chi2, n_inliers=n_inliers)


def _covariances(submap: Submap, landmark_ids: IntArray, xyz_mu: FloatArray) -> FloatArray:
    """Return (N, 3, 3) the landmarks' covariances by their views, the poses held; 0 where these do not tell."""
    order = np.argsort(landmark_ids)
    ids = landmark_ids[order]
    rows = submap.rows_of_landmarks(ids)
    keyframes, pose = np.unique(submap.observations["kf"][rows], return_inverse=True)
    T_kf_submap = se3.inverse(submap.keyframe_poses(keyframes))[pose]
    point = order[np.searchsorted(ids, submap.observations["landmark"][rows])]
    placed = point_covariance(xyz_mu, submap.K, point, T_kf_submap, submap.observed_pixels(rows)[1])
    return np.where(np.isfinite(placed).all(axis=(1, 2), keepdims=True), placed, 0.0)
