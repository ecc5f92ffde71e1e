"""Where a submap's landmarks are, and how well that is known, by the pixels that its keyframes see of them."""

from __future__ import annotations

import numpy as np

from dualslam.core.chi_square import variance_by_median
from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import project_points, projection_jacobians
from dualslam.core.geometry.triangulation import point_covariance, triangulate_n_view
from dualslam.core.noise_model import MIN_LANDMARKS, PROOF_VIEWS
from dualslam.core.types import FloatArray, IntArray
from dualslam.map.submap import Submap


def landmark_covariances(
    submap: Submap, landmark_ids: IntArray, xyz: FloatArray | None = None, before: int | None = None
) -> FloatArray:
    """Return the covariances (N, 3, 3) of landmarks given the poses of their keyframes; NaN where these fix them not.

    - `landmark_ids` (N,): each once.
    - `xyz` (N, 3): their places in the submap, where these are not its own.
    - `before`: only keyframes older than this one count.
    """
    rows, point = _views(submap, landmark_ids, before)
    if len(rows) == 0:
        return np.full((len(landmark_ids), 3, 3), np.nan)
    _, sigma = submap.observed_pixels(rows)
    ids, view = np.unique(submap.observations["kf"][rows], return_inverse=True)
    T_kf_submap = se3.inverse(submap.keyframe_poses(ids))[view]
    places = submap.landmarks["xyz_mu"][landmark_ids] if xyz is None else xyz
    return point_covariance(places, submap.K, point, T_kf_submap, sigma)


def resection_covariance(
    submap: Submap, landmark_ids: IntArray, sigma_px: FloatArray, T_cam_submap: FloatArray, covariances: FloatArray
) -> FloatArray | None:
    """Return the covariance (6, 6) of a pose by the landmarks that its image sees.

    It is that of xi in ``T_submap_cam @ exp(xi)``: rotation (rad), then translation (unit of the submap), in the
    camera's axes. Each landmark is as uncertain as its views leave it. The keyframes of these views are held.

    - `landmark_ids` (N,), `T_cam_submap` (4, 4).
    - `sigma_px` (N,): of the pixels at which they are seen.
    - `covariances` (N, 3, 3): of `landmark_covariances`; landmarks that have none are left out.

    Returns (6, 6) or None: none where fewer than `MIN_LANDMARKS` are left.
    """
    known = np.isfinite(covariances).all((1, 2)) & (submap.depths(landmark_ids, T_cam_submap) > 0)
    if np.count_nonzero(known) < MIN_LANDMARKS:
        return None
    J_pose, spread = pixel_covariances(submap, landmark_ids[known], sigma_px[known], T_cam_submap, covariances[known])
    H = (J_pose.transpose(0, 2, 1) @ np.linalg.solve(spread, J_pose)).sum(axis=0)
    try:
        return np.asarray(np.linalg.inv(H))
    except np.linalg.LinAlgError:
        return None


def pixel_covariances(
    submap: Submap, landmark_ids: IntArray, sigma_px: FloatArray, T_cam_submap: FloatArray, covariances: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return how landmarks' pixels change with the pose (N, 2, 6), and their covariances (N, 2, 2).

    They have the noise of the image and that of the landmarks' places. Arguments as for `resection_covariance`.
    """
    J_pose, J_point = projection_jacobians(submap.K, T_cam_submap, submap.landmarks["xyz_mu"][landmark_ids])
    by_place = J_point @ covariances @ J_point.transpose(0, 2, 1)
    return J_pose, by_place + sigma_px[:, None, None] ** 2 * np.eye(2)


def triangulate_landmarks(submap: Submap, landmark_ids: IntArray, before: int) -> FloatArray:
    """Return the places (N, 3) of landmarks as the keyframes older than one alone triangulate them.

    NaN where fewer than two of these see a landmark. `landmark_ids` (N,) int64: each once.
    """
    rows, point = _views(submap, landmark_ids, before)
    if len(rows) == 0:
        return np.full((len(landmark_ids), 3), np.nan)
    pixels, _ = submap.observed_pixels(rows)
    ids, column = np.unique(submap.observations["kf"][rows], return_inverse=True)
    uv, visible = np.zeros((len(landmark_ids), len(ids), 2)), np.zeros((len(landmark_ids), len(ids)), bool)
    uv[point, column], visible[point, column] = pixels, True
    xyz = np.full((len(landmark_ids), 3), np.nan)
    enough = visible.sum(1) >= 2
    T_kf_submap = se3.inverse(submap.keyframe_poses(ids))
    xyz[enough] = triangulate_n_view(uv[enough], submap.K, T_kf_submap, visible[enough]).xyz
    return xyz


def _views(submap: Submap, landmark_ids: IntArray, before: int | None) -> tuple[IntArray, IntArray]:
    """Return the live observation rows of landmarks in the keyframes before one, and each row's place in the ids."""
    rows = submap.rows_of_landmarks(landmark_ids)
    if before is not None:
        rows = rows[submap.observations["kf"][rows] < before]
    position = np.full(len(submap.landmarks), -1)
    position[landmark_ids] = np.arange(len(landmark_ids))
    return rows, position[submap.observations["landmark"][rows]]


USUAL_NOISE = 0.33
"""Standard deviation of residuals, in the pixels' sigmas, for which the inflations of claims are made: that of plain
stretches. In blurred ones it is 0.4 to 0.7."""
MIN_RESIDUALS = 10
"""What a keyframe's residuals are read from: landmarks of so many views, and so many of them. With less it is usual."""


def noise_excess(submap: Submap) -> dict[int, float]:
    """Return how many times larger than is usual each keyframe's residuals are, by their median; at least 1."""
    obs = submap.observations
    n_views = np.bincount(obs["landmark"][obs["alive"]], minlength=len(submap.landmarks))
    excess = dict.fromkeys(submap.keyframes, 1.0)
    for k, keyframe in submap.keyframes.items():
        feature = np.flatnonzero(submap.landmark_of[k] >= 0)
        ids = submap.landmark_of[k][feature]
        feature, ids = feature[n_views[ids] >= PROOF_VIEWS], ids[n_views[ids] >= PROOF_VIEWS]
        uv, _ = project_points(submap.K, se3.inverse(submap.T_submap_kf[k]), submap.landmarks["xyz_mu"][ids])
        features = keyframe.features
        chi2 = ((uv - features.uv_rect_px[feature]) ** 2).sum(axis=1) / features.sigma_px[feature] ** 2
        finite = np.isfinite(chi2)
        if np.count_nonzero(finite) >= MIN_RESIDUALS:
            variance = variance_by_median(chi2[finite], n_views[ids[finite]])
            excess[k] = max(1.0, float(np.sqrt(variance)) / USUAL_NOISE)
    return excess
