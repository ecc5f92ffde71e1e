"""Landmarks of one side of a gap, found again on the other side in the images themselves.

The map's scale beyond unusable frames, or after wide matching, depends on landmarks seen on both sides. The detector
finds few of these at half or twice the distance. With the pose roughly known, the keyframes beyond the gap are searched
for the landmarks of the last keyframes before it, by their image patches. Each find becomes a feature like any other.

The pose of a gap relocalisation comes from few matches over a long way. There a landmark is looked for once its place
is known to within the search, by the pose's covariance and its own. Landmarks far away come first; what they tell of
the pose makes way for those nearby (active search: Davison, ICCV 2003).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.arrays import concatenate
from dualslam.core.camera.base import Camera
from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import projection_jacobians, refine_pose
from dualslam.core.interfaces import Frontend
from dualslam.core.noise_model import GATE_SIGMAS, MAJORITY, TINY
from dualslam.core.types import BoolArray, Failure, Features, FloatArray, IntArray, Track, View
from dualslam.frontends.direct.warp import MIN_CONTRAST, Pyramid, build_pyramid, sample, warp_points
from dualslam.frontends.features.image_features import features_found
from dualslam.frontends.gap.uncertainty import track_uncertainty
from dualslam.frontends.tracking.keyframe_images import RIM_KEYFRAMES, KeyframeImages
from dualslam.frontends.tracking.turning import find_as_read
from dualslam.map.landmark_views import landmark_covariances
from dualslam.map.submap import Submap

FAR_KEYFRAMES = 8
"""Keyframes beyond a gap in which they are: the wider these stand, the better they know the landmarks' depths."""
SEARCH_RAD = 0.022
"""About the predicted place, in the coarser image, as an angle: a pose from few matches is off by as much."""
ROUNDS = 4
"""Searches in one frame beyond a gap at most, each from the pose that the one before has left."""
MAX_DEPTH_SIGMA = 0.1
"""Relative, of a landmark that is looked for. There are more points far away than near, and of these the ones enter a
map whose noise looks like parallax: on a rendered street, depths known to 5 % are right, to 12 % are 2 to 6 % too
small, to 20 % 5 to 13 %. A hundred of them beyond a gap would not average that out, and pass it on as scale."""
MAX_ZOOM = 4.0
"""Beyond, a patch covers another part of the scene than its landmark stands for."""
SIGMA_PX = 0.45
"""Noise of a place, in pixels of the coarser image. On a rendered street, at half the distance or twice, half of the
finds are within 0.25 to 0.5 px of the truth."""
HALF_PX = 6
"""Half the side of a patch, in pixels of the coarser image."""
MIN_CORRELATION = 0.8
"""With it, 82 to 98 % of the finds are within 1.5 px of the truth. Measured on a room and a rendered street at up to
four times the distance, with predictions up to 3 px off. The pose must reject the rest."""
MAX_RIVAL = 0.9
"""Correlation of the best place that is not beside the peak, relative to the peak's."""
BESIDE_PX = 2
"""Places so far from the peak belong to it."""


@dataclass(frozen=True, slots=True, eq=False)
class _PosePrior:
    """What a gap relocalisation knows of a frame's pose beside its landmarks: the pose and its information (6, 6)."""

    T_cam_submap: FloatArray
    information: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Sought:
    """N landmarks as one keyframe before the gap sees them."""

    keyframe_id: int
    landmark_ids: IntArray
    features: Features


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Rows of what was sought, and a feature for each."""

    row: IntArray
    features: Features


class Refinder:
    """Knows the images of a front end's latest keyframes, and whether a gap lies behind it.

    - `frontend`: the live one.
    - `camera`: the camera that rectifies the features now.
    - `model_sigma_px`: error of its model, see `CameraConfig.model_sigma_px`.
    """

    def __init__(self, submap: Submap, frontend: Frontend, camera: Callable[[], Camera], model_sigma_px: float) -> None:
        self._submap = submap
        self._frontend = frontend
        self.camera = camera
        self._model_sigma_px = model_sigma_px
        self.images = KeyframeImages()
        self._rim: list[int] = []
        self._levels: dict[int, Pyramid] = {}
        self._n_left = 0

    def remember(self, view: View) -> None:
        """Keep the image of a keyframe, and the turn by which its features are elsewhere than it shows them."""
        self.images.remember(view)

    def forget(self, keyframe_ids: Iterable[int]) -> None:
        """Forget the images of keyframes whose features are not where they were when they were remembered."""
        gone = list(keyframe_ids)
        self.images.forget(gone)
        for k in gone:
            self._levels.pop(k, None)

    def begin(self, index: int) -> None:
        """Note that a gap lies between frame `index` and the keyframes so far."""
        near = [k for k in self._submap.keyframes_near(index) if k in self.images and k != index]
        self._rim, self._n_left = near[:RIM_KEYFRAMES], FAR_KEYFRAMES
        self._levels = {k: levels for k, levels in self._levels.items() if k in self._rim}

    def extend(self, track: Track, pose_is_given: bool = False) -> Track:
        """Return a frame that is to become a keyframe with the landmarks from before the gap that its image shows.

        Its features are those that it had, and behind them those that were found; its pose is refined with all.

        `pose_is_given`: its pose and covariance are not by the landmarks that it sees, and count beside these.
        """
        view = track.view
        if self._n_left == 0 or view.image is None:
            return track
        self._n_left -= 1
        levels = build_pyramid(view.image.pixels())
        pose_prior = _PosePrior(track.T_cam_submap, _inverse(track.covariance)) if pose_is_given else None
        looked_for = np.zeros(0, np.int64)
        for _ in range(ROUNDS if pose_prior else 1):
            sought = self._sought(track, looked_for, pose_prior)
            if not sought:
                break
            found = [self._find(each, track, levels) for each in sought]
            looked_for = np.concatenate([looked_for, *(each.landmark_ids for each in sought)])
            ids = [each.landmark_ids[of.row] for each, of in zip(sought, found, strict=True)]
            features = concatenate([track.view.features, *(of.features for of in found)])
            track = self._posed(track, features, np.concatenate([track.landmark_ids, *ids]), pose_prior)
        return track

    def _sought(self, track: Track, looked_for: IntArray, pose_prior: _PosePrior | None) -> list[_Sought]:
        """Return the landmarks of the rim, of known depth and place, that the frame lacks, once, next to the gap."""
        submap, taken = self._submap, np.concatenate([track.landmark_ids, looked_for])
        pose_covariance = None if pose_prior is None else self._pose_covariance(track, pose_prior)
        found = []
        for k in self._rim:
            if k not in submap.keyframes or k not in self.images:
                continue
            feature = np.flatnonzero(submap.landmark_of[k] >= 0)
            feature = feature[~np.isin(submap.landmark_of[k][feature], taken)]
            ids = submap.landmark_of[k][feature]
            covariance = landmark_covariances(submap, ids)
            known = self._depth_known(ids, k, covariance)
            if pose_covariance is not None:
                known[known] = self._place_known(ids[known], k, track, pose_covariance, covariance[known])
            if known.any():
                taken = np.concatenate([taken, ids[known]])
                found.append(_Sought(k, ids[known], submap.keyframes[k].features.take(feature[known])))
        return found

    def _pose_covariance(self, track: Track, pose_prior: _PosePrior) -> FloatArray:
        """Return how well the gap relocalisation and the landmarks in view know the frame's pose (6, 6)."""
        by_landmarks = track_uncertainty(self._submap, track)
        if by_landmarks is None:
            return _inverse(pose_prior.information)
        return _inverse(_inverse(by_landmarks[0]) + pose_prior.information)

    def _depth_known(self, landmark_ids: IntArray, k: int, covariance: FloatArray) -> BoolArray:
        """Return which landmarks' (N,) depths in keyframe k are known, the poses taken as known."""
        T_kf_submap = se3.inverse(self._submap.T_submap_kf[k])
        along, depth = T_kf_submap[2, :3], self._submap.depths(landmark_ids, T_kf_submap)
        sigma = np.sqrt(np.einsum("i,nij,j->n", along, covariance, along)) / np.maximum(depth, TINY)
        return np.asarray(sigma < MAX_DEPTH_SIGMA, np.bool_)

    def _place_known(
        self, landmark_ids: IntArray, k: int, track: Track, pose_covariance: FloatArray, covariance: FloatArray
    ) -> BoolArray:
        """Return which landmarks' (N,) places in the frame are known to within the search."""
        submap, T = self._submap, track.T_cam_submap
        depth, depth_kf = (submap.depths(landmark_ids, T_) for T_ in (T, se3.inverse(submap.T_submap_kf[k])))
        known = depth > 0
        J_pose, J_point = projection_jacobians(submap.K, T, submap.landmarks["xyz_mu"][landmark_ids[known]])
        place = J_pose @ pose_covariance @ J_pose.swapaxes(1, 2)
        place += J_point @ covariance[known] @ J_point.swapaxes(1, 2)
        coarser = np.maximum(depth_kf[known] / depth[known], 1.0)
        sigma_rad = np.sqrt(np.linalg.eigvalsh(place)[:, -1]) / coarser / submap.K[0, 0]
        known[known] = GATE_SIGMAS * sigma_rad < SEARCH_RAD
        return np.asarray(known, np.bool_)

    def _find(self, sought: _Sought, track: Track, levels: Pyramid) -> _Found:
        """Search the image for one keyframe's landmarks."""
        camera = self.camera()
        T_kf_submap = se3.inverse(self._submap.T_submap_kf[sought.keyframe_id])
        T_cam_kf = track.T_cam_submap @ self._submap.T_submap_kf[sought.keyframe_id]
        uv_kf = sought.features.uv_px
        depth = self._submap.depths(sought.landmark_ids, T_kf_submap)
        warp = warp_points(camera, uv_kf, depth, T_cam_kf)
        uv, J, zoom = warp.uv_px, warp.J_b_a, warp.zoom
        turn_rad, turn_kf_rad = track.view.turn_rad, self.images[sought.keyframe_id].turn_rad
        uv = uv if turn_rad is None else find_as_read(uv, warp.uv_rect_px, camera, turn_rad)
        uv_kf = uv_kf if turn_kf_rad is None else find_as_read(uv_kf, warp.uv_rect_a_px, camera, turn_kf_rad)
        margin = HALF_PX * np.maximum(zoom, 1.0)[:, None]
        inside = ((uv > margin) & (uv < np.array(camera.size_px) - 1 - margin)).all(axis=1)
        usable = np.flatnonzero(inside & (depth > 0) & (zoom > 1 / MAX_ZOOM) & (zoom < MAX_ZOOM))
        matches = match_patches(
            self._levels_of(sought.keyframe_id),
            levels,
            uv_kf[usable],
            uv[usable],
            J[usable],
            SEARCH_RAD * camera.K[0, 0],
        )
        row = usable[matches.row]
        turn = np.arctan2(J[row, 1, 0] - J[row, 0, 1], J[row, 0, 0] + J[row, 1, 1])
        held, features = features_found(
            sought.features.take(row),
            matches.uv_px,
            SIGMA_PX * matches.spacing_px,
            zoom[row],
            turn,
            self._frontend,
            camera,
            self._model_sigma_px,
            turn_rad,
        )
        return _Found(row[held], features)

    def _levels_of(self, keyframe_id: int) -> Pyramid:
        if keyframe_id not in self._levels:
            self._levels[keyframe_id] = build_pyramid(self.images[keyframe_id].image.pixels())
        return self._levels[keyframe_id]

    def _posed(self, track: Track, features: Features, landmark_ids: IntArray, pose_prior: _PosePrior | None) -> Track:
        """Pose the frame by all that was found, and leave out what does not agree."""
        row = np.flatnonzero(landmark_ids >= 0)
        T, sigma = track.T_cam_submap, features.sigma_px[row]
        if pose_prior is not None:
            T, sigma = (
                pose_prior.T_cam_submap,
                np.hypot(sigma, self._place_sigmas(landmark_ids[row], track.T_cam_submap)),
            )
        estimate = refine_pose(
            self._submap.K,
            T,
            self._submap.landmarks["xyz_mu"][landmark_ids[row]],
            features.uv_rect_px[row],
            sigma,
            prior_information=None if pose_prior is None else pose_prior.information,
        )
        is_new = row >= len(track.view.features)
        if isinstance(estimate, Failure) or estimate.inliers[is_new].sum() <= MAJORITY * is_new.sum():
            return track
        landmark_ids = landmark_ids.copy()
        landmark_ids[row[~estimate.inliers]] = -1
        kept = np.ones(len(features), bool)
        kept[row[is_new & ~estimate.inliers]] = False
        view = replace(track.view, features=features.take(kept))
        return replace(track, view=view, T_cam_submap=estimate.T_cam_w, landmark_ids=landmark_ids[kept])

    def _place_sigmas(self, landmark_ids: IntArray, T_cam_submap: FloatArray) -> FloatArray:
        """Return by how many pixels (N,) landmarks may be off for their own uncertainty, either coordinate."""
        _, J = projection_jacobians(self._submap.K, T_cam_submap, self._submap.landmarks["xyz_mu"][landmark_ids])
        place = J @ landmark_covariances(self._submap, landmark_ids) @ J.swapaxes(1, 2)
        return np.asarray(np.sqrt(np.nan_to_num(np.trace(place, axis1=1, axis2=2) / 2, nan=0.0)), np.float64)


def _inverse(symmetric: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.pinv(symmetric, hermitian=True), np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class PatchMatches:
    """Rows of the points that were found, and where: (M, 2) pixels, with the size of a pixel at which it was looked."""

    row: IntArray
    uv_px: FloatArray
    spacing_px: FloatArray


def match_patches(
    levels_a: Pyramid, levels_b: Pyramid, uv_a_px: FloatArray, uv_b_px: FloatArray, J_b_a: FloatArray, radius_px: float
) -> PatchMatches:
    """Find points of one image (N of them) in another.

    - `levels_a`, `levels_b` (list of (H, W)): pyramids of the two images.
    - `uv_a_px`, `uv_b_px` (N, 2): where the points are, and where they are expected.
    - `J_b_a` (N, 2, 2): by how much a place in b moves with one in a.
    - `radius_px`: half the side of the square that is searched, in pixels of the coarser image.
    """
    zoom = np.sqrt(np.abs(np.linalg.det(J_b_a)))
    spacing = np.maximum(1.0, zoom)
    axes_b = spacing[:, None, None] * np.eye(2)
    axes_a = np.linalg.inv(J_b_a) @ axes_b
    reach = int(np.ceil(radius_px))
    template = sample(levels_a, uv_a_px, axes_a, HALF_PX)
    window = sample(levels_b, uv_b_px, axes_b, HALF_PX + reach)
    found, offset = [], []
    for n in np.flatnonzero(template.std(axis=(1, 2)) >= MIN_CONTRAST).tolist():
        score = cv2.matchTemplate(window[n], template[n], cv2.TM_CCOEFF_NORMED)
        place = _peak(score)
        if place is not None:
            found.append(n)
            offset.append(place - reach)
    row = np.array(found, np.int64)
    moved = np.array(offset, np.float64).reshape(-1, 2) * spacing[row, None]
    return PatchMatches(row, uv_b_px[row] + moved, spacing[row])


def _peak(score: NDArray[np.float32]) -> FloatArray | None:
    """Return (x, y) of a clear and single peak, to a fraction of a pixel."""
    y, x = np.unravel_index(int(score.argmax()), score.shape)
    top = float(score[y, x])
    if top < MIN_CORRELATION or not (0 < y < score.shape[0] - 1 and 0 < x < score.shape[1] - 1):
        return None
    around = score[max(y - BESIDE_PX, 0) : y + BESIDE_PX + 1, max(x - BESIDE_PX, 0) : x + BESIDE_PX + 1]
    hidden = around.copy()
    around[:] = -1.0
    rival = float(score.max())
    around[:] = hidden
    if rival > MAX_RIVAL * top:
        return None
    left, right, up, down = score[y, x - 1], score[y, x + 1], score[y - 1, x], score[y + 1, x]
    fx, fy = left - 2 * top + right, up - 2 * top + down
    return np.array([x + (left - right) / 2 / min(fx, -1e-6), y + (up - down) / 2 / min(fy, -1e-6)], np.float64)
