"""The pose of a frame against a submap: motion model, guided matching, robust pose; wide matching when that fails.

The tracker does not know in which direction time runs: it predicts from the last two frames that it was given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.chi_square import CHI2_99
from dualslam.core.config.settings import TrackingConfig
from dualslam.core.geometry import se3, sim3
from dualslam.core.geometry.projection import PoseEstimate, project_points, refine_pose
from dualslam.core.interfaces import Frontend
from dualslam.core.noise_model import MIN_CONSENSUS
from dualslam.core.types import Failure, FailureReason, FloatArray, IntArray, Track, View
from dualslam.frontends.features.matching import FeatureGrid, match_projected
from dualslam.frontends.gap.second_pose import refuse_second_pose
from dualslam.frontends.gap.uncertainty import refuse_lost_scale
from dualslam.frontends.tracking.local_map import LocalMap, Prediction, covering_keyframes, trusted
from dualslam.frontends.tracking.motion import Motion
from dualslam.frontends.tracking.pixel_search import PixelSearch
from dualslam.frontends.tracking.resection import estimate_pose
from dualslam.map.submap import NO_LANDMARK, Submap

SEARCH_RADIUS_PX = 15.0
"""Search radius about a landmark's predicted pixel, at the finest octave, when the motion model is trusted."""
LOCAL_RADIUS_PX = 4.0
"""Search radius about the pixels of the local map's landmarks, after a first pose is found."""
LOCAL_KEYFRAMES = 20
"""Covisible keyframes whose landmarks make the local map."""
WIDE_KEYFRAMES = 3
"""Recent keyframes that are tried by wide matching and PnP when guided matching fails."""
COVERING_KEYFRAMES = 20
"""Beyond these, keyframes that together show the most of the map: in a gap the camera may have looked anywhere. Each
costs about 2 ms of CPU for a frame that is not found."""

WIDER = 2.5  # second guided search: this many times the first radius
GUIDE_TOLERANCE, POSE_TOLERANCE = 0.1, 1e-3
"""Chi-square that a step may still promise when a pose counts as found (`refine_pose`): a third of its standard
deviation where it only guides the search in the local map, a thirtieth where it is the frame's."""
REDETECTED = 0.25
"""Share of the landmarks that pixels find from which on features pose a frame by themselves: a detector finds a third
of its points again from another side, and most of these match."""
GIVEN_POSE_CHI2 = 4 * CHI2_99[2]  # 99 % with 2 degrees of freedom, and the pose off by as much as a pixel


@dataclass(frozen=True, slots=True, eq=False)
class GivenPose:
    """A pose that the tracker did not find itself, with the evidence that it came with."""

    T_cam_submap: FloatArray  # (4, 4)
    n_matches: int
    n_inliers: int
    chi2: float  # mean squared whitened residual per degree of freedom of the inliers
    covariance: FloatArray  # (6, 6)
    wide: bool  # whether frames were skipped between the last one and this


class Tracker:
    """Tracks frames against one submap, one after the other, in whatever direction of time they come.

    `looks_everywhere`: wide matching also tries the keyframes that show the most of the map.
    `max_gap_scale_sigma`: largest standard deviation (relative) of the scale beyond frames that wide matching has
    skipped. Above it the frame counts as lost, unless the step is small against the depth of the scene. `pixels`: finds
    landmarks where guided search finds too few; without it wide matching comes next.
    """

    def __init__(
        self,
        frontend: Frontend,
        config: TrackingConfig,
        submap: Submap,
        camera: Camera,
        seed: int,
        looks_everywhere: bool = False,
        max_gap_scale_sigma: float = 0.025,
        pixels: PixelSearch | None = None,
    ) -> None:
        self._pixels = pixels
        self._frontend = frontend
        self._max_gap_scale_sigma = max_gap_scale_sigma
        self._config = config
        self._submap = submap
        self._camera = camera
        self._seed = seed
        self._looks_everywhere = looks_everywhere
        self._last: Track | None = None
        self._motion = Motion()
        self._local: LocalMap | None = None
        self._doubt: Failure | None = None  # what was found to look alike beyond the gap at hand

    @property
    def last(self) -> Track | None:
        """The last posed frame."""
        return self._last

    def start(self, track: Track) -> None:
        """Begin at a frame whose pose is known, at rest."""
        times_s = np.sort([keyframe.timestamp_s for keyframe in self._submap.keyframes.values()])
        at_rest = Motion(interval_s=float(np.diff(times_s).min(initial=np.inf)))
        self._last, self._motion, self._doubt = track, at_rest, None
        self.refresh()

    def refresh(self) -> None:
        """Take in the map's changes (after a keyframe): local landmarks, merged ids, the last frame's refined pose."""
        assert self._last is not None
        submap, last = self._submap, self._last
        ids = submap.current_ids(last.landmark_ids)
        view, T_cam_submap = last.view, last.T_cam_submap
        if view.index in submap.T_submap_kf:
            T_cam_submap = se3.inverse(submap.T_submap_kf[view.index])
            ids = submap.landmark_of[view.index].copy()
            view = replace(view, features=submap.keyframes[view.index].features)  # it may have more than it came with
        self._last = replace(last, view=view, landmark_ids=ids, T_cam_submap=T_cam_submap)
        self._local = self._local_map(ids[ids >= 0])

    def follow(self, S_now_then: FloatArray) -> None:
        """Take in that the map has moved as a whole where the last frame is: its pose and the motion move along."""
        assert self._last is not None
        T_submap_cam = sim3.act_on_pose(S_now_then, se3.inverse(self._last.T_cam_submap))
        self._last = replace(self._last, T_cam_submap=se3.inverse(T_submap_cam))
        self._motion = self._motion.scaled(float(sim3.scale(S_now_then)))
        self.refresh()

    def track(self, view: View, may_relocalise: bool = True) -> Track | Failure:
        """Pose a frame, also by whole keyframes if it `may_relocalise`; a failure leaves the tracker as it was."""
        assert self._last is not None, "start() comes first"
        features = view.features
        if len(features) < self._config.min_inliers and self._pixels is None:
            return Failure(FailureReason.NO_TEXTURE, f"{len(features)} features in the image")
        grid = FeatureGrid.build(features.uv_rect_px)
        T_predicted = self._motion.predict(self._last, view.timestamp_s)
        found: tuple[FloatArray, IntArray] | Failure = Failure(FailureReason.TOO_FEW_MATCHES)
        for radius_px in (SEARCH_RADIUS_PX, SEARCH_RADIUS_PX * WIDER):
            found = self._pose_from_last(view, grid, T_predicted, radius_px)
            if found:
                break
        wide, local = self.lies_beyond_gap(view), self._local
        assert local is not None
        outcome: Track | Failure
        if isinstance(found, Failure):
            outcome = found
        else:
            outcome = self._pose_from_local_map(local, view, grid, *found, T_predicted, wide)
        if self._pixels is not None and self._pixels.is_due(view, outcome):
            outcome = self._pose_from_pixels(self._pixels, view, T_predicted, wide, outcome)
        if not found and not outcome:
            found, wide = self._pose_from_wide_matches(view) if may_relocalise else found, True
            if isinstance(found, Failure):
                return found
            local = self._local_map(found[1][found[1] >= 0])
            outcome = self._pose_from_local_map(local, view, grid, *found, T_predicted, wide)
        if isinstance(outcome, Failure):
            return outcome
        if wide:
            refused = refuse_lost_scale(self._submap, outcome, self._last, self._max_gap_scale_sigma)
            if refused is None:
                refused = self._refuse_look_alike(outcome)
            if refused is not None:
                return refused
        self._accept(outcome, local)
        return outcome

    def lies_beyond_gap(self, view: View) -> bool:
        """Whether so much time has passed since the last posed frame that its motion does not lead to this one."""
        return self._last is not None and self._motion.lies_beyond_gap(self._last, view)

    def track_at(self, view: View, pose: GivenPose) -> Track:
        """Take a pose as it is, look for the landmarks of the keyframes nearest in time under it, and go on there."""
        local = self._near_map(view.index)
        track = self._look_for(local, view, pose)
        self._accept(track, local)
        return track

    def look_at(self, view: View, pose: GivenPose) -> Track:
        """Take a pose as `track_at` does; the tracker goes on from there only after `take`."""
        return self._look_for(self._near_map(view.index), view, pose)

    def track_near(self, view: View, T_cam_submap: FloatArray) -> Track | Failure:
        """Pose a frame by the landmarks of the keyframes nearest in time, from a pose near its own; see `take`."""
        local, grid = self._near_map(view.index), FeatureGrid.build(view.features.uv_rect_px)
        nothing = np.full(len(view.features), NO_LANDMARK, np.int64)
        return self._pose_from_local_map(local, view, grid, T_cam_submap, nothing, T_cam_submap, wide=True)

    def relocalise(self, view: View, keyframe_id: int) -> Track | Failure:
        """Pose a frame by a keyframe of the submap and those that see the same; continue from there, at rest."""
        features = view.features
        if len(features) < self._config.min_inliers:
            return Failure(FailureReason.NO_TEXTURE, f"{len(features)} features in the image")
        covisible, _ = self._submap.covisible(self._submap.seen_in(keyframe_id))
        about = [keyframe_id, *(k for k in covisible.tolist() if k != keyframe_id)]
        found = self._pose_from_wide_matches(view, about[:WIDE_KEYFRAMES])
        if isinstance(found, Failure):
            return found
        local, grid = self._local_map(found[1][found[1] >= 0]), FeatureGrid.build(features.uv_rect_px)
        track = self._pose_from_local_map(local, view, grid, *found, found[0], wide=True)
        if isinstance(track, Failure):
            return track
        refused = self._refuse_second_pose(track, about[:WIDE_KEYFRAMES])
        if refused is not None:
            return refused
        self.start(track)
        return track

    def take(self, track: Track) -> None:
        """Continue from a track of `look_at` or `track_near`."""
        self._accept(track, self._near_map(track.view.index))

    # --- steps

    def _look_for(self, local: LocalMap, view: View, pose: GivenPose) -> Track:
        """Return the track of a given pose: which of the local map's landmarks are where it shows them."""
        landmark_ids = np.full(len(view.features), NO_LANDMARK, np.int64)
        grid = FeatureGrid.build(view.features.uv_rect_px)
        landmark_ids, _ = self._search(local, view, grid, pose.T_cam_submap, landmark_ids)
        feature = np.flatnonzero(landmark_ids >= 0)
        uv, _ = project_points(
            self._submap.K, pose.T_cam_submap, self._submap.landmarks["xyz_mu"][landmark_ids[feature]]
        )
        error2 = ((uv - view.features.uv_rect_px[feature]) ** 2).sum(axis=1)
        fits = error2 < GIVEN_POSE_CHI2 * view.features.sigma_px[feature] ** 2
        landmark_ids[feature[~fits]] = NO_LANDMARK
        T = pose.T_cam_submap
        return Track(
            view,
            T,
            T,
            landmark_ids,
            np.zeros(0, np.int64),
            pose.n_matches,
            pose.n_inliers,
            pose.chi2,
            pose.wide,
            pose.covariance,
        )

    def _pose_from_last(
        self, view: View, grid: FeatureGrid, T_predicted: FloatArray, radius_px: float
    ) -> tuple[FloatArray, IntArray] | Failure:
        """Search the last frame's landmarks about their predicted pixels."""
        assert self._last is not None
        last_rows = np.flatnonzero(self._last.landmark_ids >= 0)
        ids = self._last.landmark_ids[last_rows]
        local = LocalMap.of_landmarks(self._submap, ids)
        prediction = self._predict_local(local, T_predicted)
        # The last frame's own descriptor is the freshest view of the landmark.
        descriptors = self._last.view.features.descriptors[last_rows][prediction.rows]
        matches = match_projected(
            self._frontend,
            grid,
            view.features,
            prediction.uv_px,
            radius_px * self._frontend.scale_factor**prediction.octave,
            descriptors,
            octave=prediction.octave,
            angle_rad=self._last.view.features.angle_rad[last_rows][prediction.rows],
        )
        rows, feature = prediction.rows[matches.index[:, 0]], matches.index[:, 1]
        return self._refine(view, T_predicted, ids[rows], local.xyz_mu.take(rows, axis=0), feature)

    def _pose_from_pixels(
        self, pixels: PixelSearch, view: View, T_predicted: FloatArray, wide: bool, guided: Track | Failure
    ) -> Track | Failure:
        """Return the track by landmarks that their pixels find, where more agree with it than with the guided one."""
        assert self._last is not None
        extended = pixels.extend(self._submap, self._last, view, T_predicted)
        if extended is None:
            return guided
        seen, landmark_ids = extended
        feature = np.flatnonzero(landmark_ids >= 0)
        ids = landmark_ids[feature]
        found = self._refine(seen, T_predicted, ids, self._submap.landmarks["xyz_mu"].take(ids, axis=0), feature)
        if isinstance(found, Failure):
            return guided
        local, T = self._local_map(found[1][found[1] >= 0]), found[0]
        track = self._pose_from_local_map(
            local, seen, FeatureGrid.build(seen.features.uv_rect_px), *found, T_predicted, wide
        )
        if isinstance(track, Failure):
            return guided
        # Where the image is sharp, its features are there again under this pose: they are better known than patches.
        nothing = np.full(len(view.features), NO_LANDMARK, np.int64)
        grid = FeatureGrid.build(view.features.uv_rect_px)
        again = self._pose_from_local_map(local, view, grid, T, nothing, T_predicted, wide)
        if isinstance(again, Track) and again.n_inliers >= REDETECTED * track.n_inliers:
            return again
        if isinstance(guided, Track) and guided.n_inliers >= track.n_inliers:
            return guided
        n_by_pixels = np.count_nonzero(track.landmark_ids[len(view.features) :] >= 0)
        return replace(track, n_by_pixels=int(n_by_pixels))

    def _pose_from_wide_matches(
        self, view: View, keyframe_ids: list[int] | None = None
    ) -> tuple[FloatArray, IntArray] | Failure:
        """Match the whole image against one keyframe after the other, pose by PnP."""
        submap, best = self._submap, Failure(FailureReason.TOO_FEW_MATCHES, "no keyframe matched")
        for k in self._wide_keyframes(view.index) if keyframe_ids is None else keyframe_ids:
            has_landmark = np.flatnonzero(submap.landmark_of[k] >= 0)
            matches = self._frontend.match_wide(submap.keyframes[k].features.take(has_landmark), view.features)
            if len(matches) < MIN_CONSENSUS:
                continue
            ids = submap.landmark_of[k][has_landmark[matches.index[:, 0]]]
            feature = matches.index[:, 1]
            estimate = estimate_pose(
                submap.K,
                self._camera.size_px,
                view.features.uv_rect_px[feature],
                submap.landmarks["xyz_mu"][ids],
                view.features.sigma_px[feature],
                self._seed,
                tolerance=GUIDE_TOLERANCE,
            )
            found = self._by_feature(view, estimate, ids, feature)
            if found:
                return found
            assert isinstance(found, Failure)
            best = found
        return best

    def _wide_keyframes(self, index: int) -> list[int]:
        near = self._submap.keyframes_near(index)[:WIDE_KEYFRAMES]
        if not self._looks_everywhere:
            return near
        covering = covering_keyframes(self._submap, COVERING_KEYFRAMES, self._config.min_inliers)
        return [*near, *(k for k in covering if k not in near)]

    def _refuse_look_alike(self, track: Track) -> Failure | None:
        """Refuse a pose across a gap if another one explains nearly as much of what the last keyframes saw before it.

        A gap beyond which two poses stood once is not crossed any more: farther on one would pass by chance.
        """
        if self._doubt is None:
            self._doubt = self._refuse_second_pose(
                track, self._submap.keyframes_near(track.view.index)[:WIDE_KEYFRAMES]
            )
        return self._doubt

    def _refuse_second_pose(self, track: Track, keyframe_ids: Sequence[int]) -> Failure | None:
        return refuse_second_pose(self._submap, track, keyframe_ids, self._frontend, self._camera, self._seed)

    def _refine(
        self, view: View, T_start: FloatArray, ids: IntArray, xyz_mu: FloatArray, feature: IntArray
    ) -> tuple[FloatArray, IntArray] | Failure:
        minimum = self._config.min_inliers
        if len(ids) < minimum:
            return Failure(FailureReason.TOO_FEW_MATCHES, f"{len(ids)} matches, {minimum} needed")
        features = view.features
        estimate = refine_pose(
            self._submap.K,
            T_start,
            xyz_mu,
            features.uv_rect_px.take(feature, axis=0),
            features.sigma_px[feature],
            tolerance=GUIDE_TOLERANCE,
        )
        return self._by_feature(view, estimate, ids, feature)

    def _by_feature(
        self, view: View, estimate: PoseEstimate | Failure, ids: IntArray, feature: IntArray
    ) -> tuple[FloatArray, IntArray] | Failure:
        """Return a pose with the landmark of each feature; a failure where too few agree."""
        if isinstance(estimate, Failure):
            return estimate
        if estimate.n_inliers < self._config.min_inliers:
            return Failure(FailureReason.TOO_FEW_INLIERS, f"{estimate.n_inliers} inliers of {len(ids)} matches")
        landmark_ids = np.full(len(view.features), NO_LANDMARK, np.int64)
        landmark_ids[feature[estimate.inliers]] = ids[estimate.inliers]
        return estimate.T_cam_w, landmark_ids

    def _pose_from_local_map(
        self,
        local: LocalMap,
        view: View,
        grid: FeatureGrid,
        T_cam_submap: FloatArray,
        landmark_ids: IntArray,
        T_predicted: FloatArray,
        wide: bool,
    ) -> Track | Failure:
        """Add the local map's other landmarks about their pixels under the first pose, and refine with all of them."""
        features, submap = view.features, self._submap
        landmark_ids, visible = self._search(local, view, grid, T_cam_submap, landmark_ids)
        feature = np.flatnonzero(landmark_ids >= 0)
        ids = landmark_ids[feature]
        estimate = refine_pose(
            submap.K,
            T_cam_submap,
            submap.landmarks["xyz_mu"].take(ids, axis=0),
            features.uv_rect_px.take(feature, axis=0),
            features.sigma_px[feature],
            tolerance=POSE_TOLERANCE,
            counted=trusted(submap, ids, T_cam_submap, self._config.min_inliers),
        )
        if isinstance(estimate, Failure):
            return estimate
        if estimate.n_inliers < self._config.min_inliers:
            return Failure(FailureReason.TOO_FEW_INLIERS, f"{estimate.n_inliers} inliers of {len(ids)} matches")
        landmark_ids[feature[~estimate.inliers]] = NO_LANDMARK
        return Track(
            view,
            estimate.T_cam_w,
            T_predicted,
            landmark_ids,
            visible_ids=visible,
            n_matches=len(ids),
            n_inliers=estimate.n_inliers,
            chi2=float(estimate.chi2[estimate.inliers].mean() / 2),
            wide=wide,
            covariance=estimate.covariance,
        )

    def _search(
        self, local: LocalMap, view: View, grid: FeatureGrid, T_cam_submap: FloatArray, landmark_ids: IntArray
    ) -> tuple[IntArray, IntArray]:
        """Return the features' landmarks, those of the local map added that were not among them, and all in view."""
        features = view.features
        prediction = self._predict_local(local, T_cam_submap)
        new = ~self._submap.mask_of(landmark_ids)[local.landmark_ids[prediction.rows]]
        matches = match_projected(
            self._frontend,
            grid,
            features,
            prediction.uv_px[new],
            LOCAL_RADIUS_PX * self._frontend.scale_factor ** prediction.octave[new],
            local.descriptors[prediction.rows[new]],
            octave=prediction.octave[new],
            taken=landmark_ids >= 0,
        )
        landmark_ids = landmark_ids.copy()
        landmark_ids[matches.index[:, 1]] = local.landmark_ids[prediction.rows[new][matches.index[:, 0]]]
        return landmark_ids, local.landmark_ids[prediction.rows]

    def _accept(self, track: Track, local: LocalMap) -> None:
        assert self._last is not None
        self._motion = self._motion.next(self._last, track)
        self._last, self._local, self._doubt = track, local, None
        if self._pixels is not None:
            self._pixels.note(track)

    # --- the local map

    def _predict_local(self, local: LocalMap, T_cam_submap: FloatArray) -> Prediction:
        frontend = self._frontend
        return local.predict(T_cam_submap, self._submap.K, self._camera, frontend.scale_factor, frontend.n_octaves)

    def _local_map(self, landmark_ids: IntArray) -> LocalMap:
        keyframe_ids, _ = self._submap.covisible(landmark_ids)
        return LocalMap.of_keyframes(self._submap, keyframe_ids[:LOCAL_KEYFRAMES])

    def _near_map(self, index: int) -> LocalMap:
        return LocalMap.of_keyframes(self._submap, self._submap.keyframes_near(index)[:LOCAL_KEYFRAMES])
