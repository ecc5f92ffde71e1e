"""Registration of single frames in a finished map: a pose by all keyframes that a frame resembles, together."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.chi_square import CHI2_99, squared_distances
from dualslam.core.config.settings import Config
from dualslam.core.firsts import is_first
from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import project_points
from dualslam.core.geometry.two_view import fundamental_from_pose, sampson_error
from dualslam.core.interfaces import Frontend
from dualslam.core.noise_model import MIN_CONSENSUS, PROOF_VIEWS
from dualslam.core.types import BoolArray, Failure, FailureReason, Features, FloatArray, IntArray, Keyframe, Track, View
from dualslam.frontends.gap.second_pose import refuse_second_pose
from dualslam.frontends.tracking.mapper import Mapper
from dualslam.frontends.tracking.resection import estimate_pose
from dualslam.frontends.tracking.two_view_hypotheses import estimate_relative_pose
from dualslam.map.landmark_views import landmark_covariances, pixel_covariances
from dualslam.map.submap import NO_LANDMARK, Submap

BEFORE = 4
"""Keyframes before each one that the map is triangulated again with."""


class Registrar:
    """Poses frames in a submap, in any order, and extends the submap by them.

    Tracking asks one keyframe after the other. Where steps are wide, each holds a few of the landmarks that a frame
    shows, and all together hold its pose.
    """

    def __init__(self, frontend: Frontend, config: Config, submap: Submap, camera: Camera) -> None:
        self._frontend, self._config, self._submap, self._camera = frontend, config, submap, camera
        self._mapper = Mapper(frontend, config.mapping, submap, camera)
        self._matches: dict[tuple[int, int], IntArray] = {}

    def densify(self) -> None:
        """Triangulate what the submap's keyframes share with those before them, whether tracking needed it or not."""
        ids = sorted(self._submap.keyframes)
        for n, k in enumerate(ids):
            self._mapper.extend(k, ids[max(n - BEFORE, 0) : n][::-1])

    def pose(self, view: View, keyframe_ids: Collection[int]) -> Track | Failure:
        """Pose a frame by the landmarks of some keyframes that three views prove.

        A feature takes the landmark that most of these keyframes match.
        """
        submap, features = self._submap, view.features
        pairs = [self._landmarks_of(view, k) for k in keyframe_ids]
        feature, landmark = np.concatenate([np.zeros((0, 2), np.int64), *pairs]).T
        pair, votes = np.unique(np.column_stack((feature, landmark)), axis=0, return_counts=True)
        pair = pair[np.lexsort((pair[:, 1], -submap.n_observations(pair[:, 1]), -votes))]
        pair = pair[is_first(pair[:, 0])]
        pair = pair[is_first(pair[:, 1])]
        feature, landmark = pair.T
        if len(pair) < MIN_CONSENSUS:
            return Failure(FailureReason.TOO_FEW_MATCHES, f"{len(pair)} landmarks match")
        estimate = estimate_pose(
            submap.K,
            self._camera.size_px,
            features.uv_rect_px[feature],
            submap.landmarks["xyz_mu"][landmark],
            features.sigma_px[feature],
            self._config.seed,
            min_inliers=MIN_CONSENSUS,
        )
        if isinstance(estimate, Failure):
            return estimate
        unsure = ~estimate.inliers
        unsure[unsure] = self._may_be_seen_at(landmark[unsure], features.take(feature[unsure]), estimate.T_cam_w)
        landmark_ids = np.full(len(features), NO_LANDMARK, np.int64)
        landmark_ids[feature[estimate.inliers]] = landmark[estimate.inliers]
        return Track(
            view,
            estimate.T_cam_w,
            estimate.T_cam_w,
            landmark_ids,
            np.zeros(0, np.int64),
            len(pair) - int(np.count_nonzero(unsure)),
            estimate.n_inliers,
            float(estimate.chi2[estimate.inliers].mean() / 2),
            True,
            estimate.covariance,
        )

    def refuse_repeated(self, track: Track, keyframe_ids: Collection[int]) -> Failure | None:
        """Refuse a pose if another one explains nearly as much: then the scene repeats itself."""
        sight = self._submap, track, list(keyframe_ids), self._frontend, self._camera, self._config.seed
        return refuse_second_pose(*sight)

    def insert(self, track: Track) -> None:
        """Make a frame a keyframe of the submap that sees the landmarks by which it was posed."""
        view, feature = track.view, np.flatnonzero(track.landmark_ids != NO_LANDMARK)
        self._submap.add_keyframe(
            Keyframe(view.index, view.timestamp_s, view.features), se3.inverse(track.T_cam_submap)
        )
        self._submap.add_observations(view.index, feature, track.landmark_ids[feature])

    def extend(self, keyframe_id: int, others: Collection[int]) -> None:
        """Look for more of the landmarks of some keyframes in another, and triangulate new ones with them."""
        self._mapper.extend(keyframe_id, list(others))

    # --- steps

    def _landmarks_of(self, view: View, keyframe_id: int) -> IntArray:
        """Return (N, 2) features of a frame, and the landmarks of a keyframe that they match."""
        keyframe = self._submap.keyframes[keyframe_id]
        in_keyframe, in_view = self._matched(keyframe_id, keyframe.features, view).T
        landmark = self._submap.landmark_of[keyframe_id][in_keyframe]
        seen = (landmark != NO_LANDMARK) & (self._submap.n_observations(landmark) >= PROOF_VIEWS)
        return np.column_stack((in_view[seen], landmark[seen]))

    def _may_be_seen_at(self, landmark_ids: IntArray, features: Features, T_cam_submap: FloatArray) -> BoolArray:
        """Return which landmarks (N,) are too uncertain to contradict a pose that shows them beside these features."""
        submap = self._submap
        covariances = landmark_covariances(submap, landmark_ids)
        uv, depth = project_points(submap.K, T_cam_submap, submap.landmarks["xyz_mu"][landmark_ids])
        _, spread = pixel_covariances(submap, landmark_ids, features.sigma_px, T_cam_submap, covariances)
        known = np.isfinite(spread).all((1, 2)) & (depth > 0)
        off2 = np.zeros(len(landmark_ids))
        off2[known] = squared_distances((uv - features.uv_rect_px)[known], spread[known])
        return np.asarray(known & (off2 < CHI2_99[2]))

    def _matched(self, keyframe_id: int, features: Features, view: View) -> IntArray:
        """Return (N, 2) features of a keyframe and a frame that match, if one relative pose explains them."""
        key = keyframe_id, view.index
        if key not in self._matches:
            pairs = self._frontend.match_wide(features, view.features).index
            if len(pairs) >= MIN_CONSENSUS:
                pairs = pairs[self._explained(features.take(pairs[:, 0]), view.features.take(pairs[:, 1]))]
            self._matches[key] = pairs if len(pairs) >= MIN_CONSENSUS else pairs[:0]
        return self._matches[key]

    def _explained(self, a: Features, b: Features) -> BoolArray:
        """Return which matched features (N,) lie on each other's epipolar lines under the pose that most agree with."""
        pixels, sigma = (a.uv_rect_px, b.uv_rect_px), np.maximum(a.sigma_px, b.sigma_px)
        K, seed = self._submap.K, self._config.seed
        T_b_a = estimate_relative_pose(*pixels, sigma, K, self._camera.size_px, seed)
        return np.asarray(sampson_error(fundamental_from_pose(K, T_b_a), *pixels) < CHI2_99[1] * sigma**2)
