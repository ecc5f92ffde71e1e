"""Registration of single frames in a finished map: a pose by all keyframes that a frame resembles, together.

Landmarks come from matches of whole images alone, as far as one relative pose explains them. A search near where the
poses expect a point always finds something that confirms them, and where steps are wide it is often another thing.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

import numpy as np
from scipy.sparse import csr_array

from dualslam.core.arrays import is_first
from dualslam.core.camera.base import Camera
from dualslam.core.chi_square import CHI2_95, CHI2_99, squared_distances
from dualslam.core.config.settings import Config
from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import project_points
from dualslam.core.geometry.triangulation import in_front, triangulate_two_view
from dualslam.core.geometry.two_view import fundamental_from_pose, sampson_error
from dualslam.core.interfaces import Frontend
from dualslam.core.noise_model import MIN_CONSENSUS, PROOF_VIEWS
from dualslam.core.types import BoolArray, Failure, FailureReason, Features, FloatArray, IntArray, Keyframe, Track, View
from dualslam.frontends.gap.second_pose import refuse_second_pose
from dualslam.frontends.tracking.local_map import LocalMap
from dualslam.frontends.tracking.mapper import MIN_PARALLAX_DEG
from dualslam.frontends.tracking.resection import estimate_pose
from dualslam.frontends.tracking.two_view_hypotheses import estimate_relative_pose
from dualslam.map.landmark_views import landmark_covariances, pixel_covariances
from dualslam.map.submap import NO_LANDMARK, Submap

APART_S = 2.0
"""Seconds between keyframes from which on one comes back to what the other has seen; before, tracking ties them."""
BEFORE = 4
"""Keyframes before each one that it is matched with again."""


class Registrar:
    """Poses frames in a submap, in any order, and extends the submap by them.

    Tracking asks one keyframe after the other. Where steps are wide, each holds a few of the landmarks that a frame
    shows, and all together hold its pose.
    """

    def __init__(self, frontend: Frontend, config: Config, submap: Submap, camera: Camera) -> None:
        self._frontend, self._config, self._submap, self._camera = frontend, config, submap, camera
        self._matches: dict[tuple[int, int], IntArray] = {}

    def densify(self) -> None:
        """Match the submap's keyframes with those before them, whether tracking needed it or not."""
        ids = sorted(self._submap.keyframes)
        for n, k in enumerate(ids):
            self.extend(k, ids[max(n - BEFORE, 0) : n][::-1])

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

    def tie(self, find_alike: Callable[[Collection[int]], Mapping[int, list[int]]]) -> int:
        """Let keyframes that resemble each other share the landmarks that both show, where they share few.

        A part of a map that lies askew is not found again where tracking looks for it, and is mapped once more.

        `find_alike`: asks which keyframes each of some resembles.

        Returns int: how many pairs of features have come to see one landmark.
        """
        pairs = self._sharing_too_little()
        if not len(pairs):
            return 0
        alike, matches = find_alike(np.unique(pairs).tolist()), []
        for a, b in pairs.tolist():
            if b in alike.get(a, ()) or a in alike.get(b, ()):
                keyframe = self._submap.keyframes[b]
                matches.append((a, b, self._matched(a, View(b, keyframe.timestamp_s, keyframe.features))))
        return share_landmarks(self._submap, matches)

    def extend(self, keyframe_id: int, others: Collection[int]) -> None:
        """Carry landmarks on along a keyframe's matches with some others, merge those that are one, make new ones."""
        keyframe = self._submap.keyframes[keyframe_id]
        view = View(keyframe_id, keyframe.timestamp_s, keyframe.features)
        for other in others:
            in_other, in_keyframe = self._matched(other, view).T
            self._carry_on(other, in_other, keyframe_id, in_keyframe)
            self._carry_on(keyframe_id, in_keyframe, other, in_other)
            self._merge(keyframe_id, in_keyframe, other, in_other)
            self._triangulate(keyframe_id, in_keyframe, other, in_other)

    # --- steps

    def _carry_on(self, a: int, in_a: IntArray, b: int, in_b: IntArray) -> None:
        """Let a keyframe b see the landmarks of another, a, at the features that match there and have none."""
        submap = self._submap
        landmark = submap.landmark_of[a][in_a]
        new = (landmark != NO_LANDMARK) & (submap.landmark_of[b][in_b] == NO_LANDMARK)
        new &= ~np.isin(landmark, submap.landmark_of[b])
        new[new] = self._appear_at(landmark[new], b, in_b[new])
        submap.add_observations(b, in_b[new], landmark[new])

    def _merge(self, a: int, in_a: IntArray, b: int, in_b: IntArray) -> None:
        """Make matched landmarks one where each appears at the other's feature, towards that with more views."""
        of_a, of_b = self._submap.landmark_of[a][in_a], self._submap.landmark_of[b][in_b]
        two = (of_a != NO_LANDMARK) & (of_b != NO_LANDMARK) & (of_a != of_b)
        two[two] = self._appear_at(of_a[two], b, in_b[two]) & self._appear_at(of_b[two], a, in_a[two])
        n_of_a, n_of_b = self._submap.n_observations(np.stack([of_a[two], of_b[two]]))
        swap, pair = n_of_b > n_of_a, np.stack([of_a[two], of_b[two]])
        self._submap.merge_landmarks(np.where(swap, pair[1], pair[0]), np.where(swap, pair[0], pair[1]))

    def _triangulate(self, a: int, in_a: IntArray, b: int, in_b: IntArray) -> None:
        """Make landmarks of matched features of which neither has one."""
        submap = self._submap
        free = (submap.landmark_of[a][in_a] == NO_LANDMARK) & (submap.landmark_of[b][in_b] == NO_LANDMARK)
        in_a, in_b = in_a[free], in_b[free]
        here, there = submap.keyframes[a].features.take(in_a), submap.keyframes[b].features.take(in_b)
        T_submap_a, T_submap_b = submap.T_submap_kf[a], submap.T_submap_kf[b]
        points = triangulate_two_view(here.uv_rect_px, there.uv_rect_px, submap.K, T_submap_a, T_submap_b)
        good = in_front(points.depth_a, points.depth_b)
        good &= points.cos_parallax < np.cos(np.radians(MIN_PARALLAX_DEG))
        good &= points.error2_a < CHI2_95[2] * here.sigma_px**2
        good &= points.error2_b < CHI2_95[2] * there.sigma_px**2
        ids = submap.add_landmarks(points.xyz[good], here.descriptors[good], here.scale[good], a)
        submap.add_observations(a, in_a[good], ids)
        submap.add_observations(b, in_b[good], ids)

    def _appear_at(self, landmark_ids: IntArray, keyframe_id: int, feature: IntArray) -> BoolArray:
        """Return which landmarks (N,) a keyframe's pose shows at these of its features."""
        submap, features = self._submap, self._submap.keyframes[keyframe_id].features.take(feature)
        T_kf_submap = se3.inverse(submap.T_submap_kf[keyframe_id])
        uv, depth = project_points(submap.K, T_kf_submap, submap.landmarks["xyz_mu"][landmark_ids])
        off2 = ((uv - features.uv_rect_px) ** 2).sum(axis=1)
        return np.asarray((depth > 0) & (off2 < CHI2_95[2] * features.sigma_px**2))

    def _sharing_too_little(self) -> IntArray:
        """Return the pairs (N, 2) that by the map's own places see enough of the same to be tracked by, and share less.

        The earlier keyframe comes first.
        """
        submap, enough = self._submap, self._config.keyframes.weak_landmarks
        ids = np.array(sorted(submap.keyframes), np.int64)
        local = LocalMap.of_keyframes(submap, ids.tolist())
        seen = _rows_of([np.flatnonzero(np.isin(local.landmark_ids, submap.seen_in(k))) for k in ids.tolist()], local)
        shown = _rows_of([self._shown_in(k, local) for k in ids.tolist()], local)
        shared, expected = (seen @ seen.T).toarray(), (shown @ seen.T).toarray()
        times_s = np.array([submap.keyframes[k].timestamp_s for k in ids.tolist()])
        few = (times_s[None] - times_s[:, None] > APART_S) & (shared < enough)
        return ids[np.argwhere(few & (np.minimum(expected, expected.T) >= enough))]

    def _shown_in(self, keyframe_id: int, local: LocalMap) -> IntArray:
        """Return the rows of the landmarks that a keyframe should see."""
        T_cam_submap, pyramid = se3.inverse(self._submap.T_submap_kf[keyframe_id]), self._frontend
        camera = self._submap.K, self._camera
        return local.predict(T_cam_submap, *camera, pyramid.scale_factor, pyramid.n_octaves).rows

    def _landmarks_of(self, view: View, keyframe_id: int) -> IntArray:
        """Return (N, 2) features of a frame, and the landmarks of a keyframe that they match."""
        in_keyframe, in_view = self._matched(keyframe_id, view).T
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

    def _matched(self, keyframe_id: int, view: View) -> IntArray:
        """Return (N, 2) features of a keyframe and a frame that match, if one relative pose explains them."""
        key, features = (keyframe_id, view.index), self._submap.keyframes[keyframe_id].features
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


def _rows_of(columns: list[IntArray], local: LocalMap) -> csr_array:
    """Return a matrix of ones in some columns of each row, one column for each landmark."""
    ends = np.cumsum([0, *map(len, columns)])
    return csr_array((np.ones(ends[-1], np.int32), np.concatenate(columns), ends), (len(columns), len(local)))


def share_landmarks(submap: Submap, matches: Collection[tuple[int, int, IntArray]]) -> int:
    """Let matched features of keyframes see one landmark, where one of the two has any, in place.

    A landmark is seen once in a keyframe: what would give it two features there is passed over.

    `matches`: two keyframes each, and (N, 2) their features that show the same.

    Returns int: how many pairs of features have come to see one landmark.
    """
    named = [submap.landmark_of[k][own] for a, b, pairs in matches for k, own in zip((a, b), pairs.T, strict=True)]
    obs, rows = submap.observations, submap.rows_of_landmarks(np.concatenate([np.zeros(0, np.int64), *named]))
    seen_in: dict[int, set[int]] = {}
    for landmark, k in zip(obs["landmark"][rows].tolist(), obs["kf"][rows].tolist(), strict=True):
        seen_in.setdefault(landmark, set()).add(k)
    landmark_of = {k: ids.tolist() for k, ids in submap.landmark_of.items()}
    heir: dict[int, int] = {}
    added: dict[tuple[int, int], int] = {}

    def now(landmark: int) -> int:
        while landmark in heir:
            landmark = heir[landmark]
        return landmark

    for k_a, k_b, pairs in matches:
        for f_a, f_b in pairs.tolist():
            a, b = now(landmark_of[k_a][f_a]), now(landmark_of[k_b][f_b])
            if a == b:
                continue
            if NO_LANDMARK in (a, b):
                k, feature, landmark = (k_a, f_a, b) if a == NO_LANDMARK else (k_b, f_b, a)
                if k not in seen_in[landmark]:
                    seen_in[landmark].add(k)
                    landmark_of[k][feature] = added[k, feature] = landmark
            elif seen_in[a].isdisjoint(seen_in[b]):
                keep, drop = (a, b) if len(seen_in[a]) >= len(seen_in[b]) else (b, a)
                seen_in[keep] |= seen_in.pop(drop)
                heir[drop] = keep
    submap.merge_landmarks(np.array([now(j) for j in heir], np.int64), np.array(list(heir), np.int64))
    kf, feature = np.array(list(added), np.int64).reshape(-1, 2).T
    submap.add_observations(kf, feature, np.array([now(j) for j in added.values()], np.int64))
    return len(heir) + len(added)
