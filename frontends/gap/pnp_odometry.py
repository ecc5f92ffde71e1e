"""Poses by a front end of its own, frame to frame (paper, section III-B); keyframes and landmarks of the live one.

Features of another front end, found in the buffered images, are matched from frame to frame; their points, triangulated
from the frames before, give each frame's pose by PnP. Under that pose the live front end looks for the submap's
landmarks, and what it finds there makes the frame a keyframe like any other: landmarks are reconstructed from live
features, and the factor graph solves for the pose anew. What other attempts took for the pose plays no part.

Or the live front end walks by itself as far as it can (`tracks_live`), which is ten times as fast, and the other one
poses only the frames where it fails.

Where the next frame cannot be posed so (blur, black-out, frames that are missing) the odometry crosses the gap: it
matches each further frame with several frames before the gap, and believes a pose only once a second frame beyond the
gap, posed by itself, sees the same points where they should be.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from dualslam.config.settings import Config
from dualslam.core.bundle import BundleAdjuster
from dualslam.core.estimates import KeyframeReport
from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import project_points, refine_pose
from dualslam.core.interfaces import Frontend, SubmapGraph
from dualslam.core.support import find_lack_of_support
from dualslam.core.types import Failure, FailureReason, Features, FloatArray, IntArray, Matches, Track, View
from dualslam.frontends.gap.auxiliary_features import AuxiliaryFeatures
from dualslam.frontends.gap.auxiliary_map import AuxiliaryMap, triangulate
from dualslam.frontends.gap.consensus import CONFIRMING_SHARE, BeyondGap, confirmed_share
from dualslam.frontends.gap.relocalisation import GapPose, relocalise_across_gap
from dualslam.frontends.gap.route import Route, find_lack
from dualslam.frontends.gap.second_pose import refuse_look_alike
from dualslam.frontends.gap.uncertainty import SMALL_STEP
from dualslam.frontends.tracking.resection import resect
from dualslam.frontends.tracking.tracker import GivenPose
from dualslam.frontends.tracking.visual import VisualFrontEnd
from dualslam.map.submap import NO_LANDMARK, Submap

FOLLOW_FRAMES = 2  # frames that the next one is matched with
POINT_FRAMES = 6  # frames that a point is triangulated from
GAP_FRAMES = 5  # frames before a gap that those beyond it are matched with
SEED_KEYFRAMES = 8  # keyframes of the submap that the walk starts from


@dataclass(frozen=True, slots=True, eq=False)
class _Beyond(BeyondGap):
    """A frame beyond a gap, with its view."""

    view: View

    def track(self, T_cam_submap: FloatArray) -> Track:
        """Return the frame with a pose that it was given in the end, and no landmarks."""
        wide, ids = self.pose, np.full(len(self.view.features), NO_LANDMARK, np.int64)
        n, n_inliers = len(wide.inliers), int(wide.inliers.sum())
        numbers = (n, n_inliers, wide.chi2)
        none = np.zeros(0, np.int64)
        return Track(self.view, T_cam_submap, T_cam_submap, ids, none, *numbers, wide=True, covariance=wide.covariance)


class PnpOdometry:
    """Implements `VisualOdometry` on the live front end's submap with another front end's poses.

    Parameters
    ----------
    live : VisualFrontEnd
        Of the submap.
    auxiliary : Frontend
    features : AuxiliaryFeatures
        The auxiliary front end's.
    route : Route
    tracks_live : bool
        The live front end poses the frames as long as it can by itself, and the auxiliary front end where it cannot.
    """

    def __init__(
        self,
        live: VisualFrontEnd,
        auxiliary: Frontend,
        features: AuxiliaryFeatures,
        route: Route,
        adjuster: BundleAdjuster,
        config: Config,
        size_px: tuple[int, int],
        tracks_live: bool = False,
    ) -> None:
        self.submap = live.submap
        self.graph = live.graph
        self._live = live
        self._auxiliary = auxiliary
        self._auxiliary_features = features
        self._route = route
        self._adjuster = adjuster
        self._config = config
        self._min_features = config.tracking.min_inliers
        self._size_px = size_px
        self._map = AuxiliaryMap(live.submap)
        self._tracks_live = tracks_live
        self._pending: dict[int, View] = {}  # posed, but without features of the auxiliary front end as yet
        self._following = False  # whether the last frame that was given has a pose
        self._relocalised: int | None = None  # the last frame that a gap relocalisation has posed
        self._confirmed: tuple[_Beyond, FloatArray] | None = (
            None  # with its pose from the last gap relocalisation's frame
        )
        self._doubt: Failure | None = None  # what was found to look alike beyond the gap at hand
        self._beyond: _Beyond | None = None  # the last frame beyond a gap, until another confirms it

    # --- the VisualOdometry protocol, as far as the live front end does it

    @property
    def reference_id(self) -> int:
        """The keyframe that frames are posed against."""
        return self._live.reference_id

    def adopt(self, graph: SubmapGraph, before: Submap) -> None:
        """Go on with another graph of the same submap."""
        self._live.adopt(graph, before)
        self.graph = graph

    def keep(self, keyframe_ids: Set[int]) -> None:
        """Never cull these keyframes."""
        self._live.keep(keyframe_ids)

    def confirmed(self) -> Track | None:
        """Return the first frame beyond a gap, when the one just given has confirmed it: where that one stands now."""
        if self._confirmed is None or self._relocalised is None:
            return None
        first, T_first_relocalised = self._confirmed
        return first.track(T_first_relocalised @ self._map.T_cam_submap(self._relocalised))

    def relative_pose(self, track: Track) -> FloatArray:
        """Return ``T_kf_cam``: the track's pose relative to the reference keyframe."""
        return self._live.relative_pose(track)

    def keyframe_due(self, track: Track) -> bool:
        """Whether the frame should become a keyframe: in any case after a gap relocalisation, which only its landmarks
        tie down.
        """
        return track.wide or self._live.keyframe_due(track)

    def go_by_known(self, track: Track) -> None:
        """Go by the keyframe of an earlier run that is there for a frame which would have become one."""
        self._live.go_by_known(track)

    def insert_keyframe(self, track: Track) -> KeyframeReport | Failure:
        """Make the frame a keyframe and solve the graph."""
        report = self._live.insert_keyframe(track, pose_is_given=track.view.index == self._relocalised)
        if isinstance(report, Failure):
            return report
        self._map.put(track.view.index, track.view.index, se3.inverse(self.submap.T_submap_kf[track.view.index]))
        self._prefetch_for_gap(track.view.index)
        return report

    # --- its own

    def start_at(self, keyframe_id: int) -> None:
        """Begin at a keyframe of the submap: it and its neighbours in time give the first points."""
        self._live.start_at(keyframe_id)
        nearest = self.submap.keyframes_near(keyframe_id)[:SEED_KEYFRAMES]
        own = {view.index: view for view in self._route.own}
        for k in reversed(nearest):
            if k in own:
                self._map.put(k, k, se3.inverse(self.submap.T_submap_kf[k]))
                self._pending[k] = own[k]
        self._following = True
        self._prefetch_for_gap(keyframe_id)

    def track(self, view: View) -> Track | Failure:
        """Pose a frame."""
        self._confirmed = None
        if view.index in self.submap.keyframes:
            return self._meet(view)
        if self._live.lies_beyond_gap(view):
            self._following = False
        if self._tracks_live and self._following:
            track = self._live.follow(view)
            if not isinstance(track, Failure) and self._healthy(track.n_inliers, track.n_matches, track.chi2):
                self._map.put(view.index, self.reference_id, track.T_cam_submap)
                self._pending[view.index] = view
                return track
        features: Features | Failure | None = find_lack(view, self._min_features)
        if features is None:
            # The frame that confirms another is the last that is needed: the live front end goes on from there.
            is_last = self._tracks_live and self._beyond is not None
            ahead = () if is_last else self._route.usable_after(view, self._min_features)
            self._auxiliary_features.prefetch(chain(self._needed().values(), [view], ahead))
            self._catch_up()
            features = self._look_at(view)
        if isinstance(features, Failure):
            self._following = False
            return features
        pose: GivenPose | Track | Failure = Failure(FailureReason.TOO_FEW_MATCHES)
        if self._following:
            pose = self._follow(view.index, features)
        if isinstance(pose, Failure):
            self._following = False
            pose = self._relocalise(view, features)
        if isinstance(pose, Failure):
            return pose
        track = pose if isinstance(pose, Track) else self._live.track_at(view, pose)
        self._following, self._beyond, self._doubt = True, None, None
        self._map.put(view.index, self.reference_id, track.T_cam_submap)
        self._forget()
        return track

    def _meet(self, view: View) -> Track:
        """Come to a frame that is a keyframe of the submap already."""
        T_cam_submap = se3.inverse(self.submap.T_submap_kf[view.index])
        if view.index not in self._map.frames:
            self._map.put(view.index, view.index, T_cam_submap)
            self._pending[view.index] = view
        self._following = True
        n = int((self.submap.landmark_of[view.index] >= 0).sum())
        return self._live.track_at(view, GivenPose(T_cam_submap, n, n, 1.0, np.zeros((6, 6)), wide=False))

    def _catch_up(self) -> None:
        """Find the auxiliary front end's features in the frames that have been posed without them, those that the next
        one needs.
        """
        for index, view in self._needed().items():
            features = self._features(view)
            if not isinstance(features, Failure):
                self._map.add(index, features, self._matches(features, self._map.frames[-GAP_FRAMES:]))
        self._pending = {}

    def _needed(self) -> dict[int, View]:
        """Return the frames, of those posed without the auxiliary front end's features, that it needs to pose the next
        one.
        """
        needed = {*self._pending_keyframes(), *list(self._pending)[-FOLLOW_FRAMES:]}
        return {index: view for index, view in self._pending.items() if index in needed}

    def _pending_keyframes(self) -> list[int]:
        return [k for k in self._pending if k in self.submap.keyframes][-SEED_KEYFRAMES:]

    def _prefetch_for_gap(self, index: int) -> None:
        """Have the auxiliary front end look at keyframes, as long as the gap lies ahead that it is needed for."""
        if index > self._route.overlap_id:
            self._auxiliary_features.prefetch([self._pending[k] for k in self._pending_keyframes()])

    def _features(self, view: View) -> Features | Failure:
        lack = find_lack(view, self._min_features)
        return self._look_at(view) if lack is None else lack

    def _look_at(self, view: View) -> Features | Failure:
        features = self._auxiliary_features.of(view)
        if not isinstance(features, Failure) and len(features) < self._min_features:
            return Failure(FailureReason.NO_TEXTURE, f"{len(features)} features of {self._auxiliary.name} in the image")
        return features

    def _matches(self, features: Features, frames: list[int]) -> dict[int, Matches]:
        return {k: self._auxiliary.match_wide(self._map.features(k), features) for k in reversed(frames)}

    def _forget(self) -> None:
        """Let go of frames that no later one will be compared with."""
        for index in self._map.frames[:-POINT_FRAMES]:
            if index not in self.submap.keyframes:
                self._map.drop(index)

    # --- from frame to frame

    def _follow(self, index: int, features: Features) -> GivenPose | Failure:
        """PnP against the points of the frames before."""
        frames = self._map.frames[-POINT_FRAMES:]
        self._map.add(index, features, self._matches(features, frames[-FOLLOW_FRAMES:]))
        rows = self._map.rows_with_track(index)
        xyz, good = triangulate(self._map.views(index, rows, frames), self.submap.K)
        pose = self._pnp(features, rows[good], xyz[good])
        if isinstance(pose, Failure):
            self._map.drop(index)
        return pose

    def _pnp(self, features: Features, rows: IntArray, xyz: FloatArray) -> GivenPose | Failure:
        minimum = self._config.health.min_inliers
        if len(rows) < minimum:
            return Failure(FailureReason.TOO_FEW_MATCHES, f"{len(rows)} points of {self._auxiliary.name}")
        uv, sigma = features.uv_rect_px[rows], features.sigma_px[rows]
        T = resect(self.submap.K, self._size_px, uv, xyz, float(np.median(sigma)), self._config.seed)
        found = refine_pose(self.submap.K, T, xyz, uv, sigma, min_inliers=minimum)
        if isinstance(found, Failure):
            return found
        chi2 = float(found.chi2[found.inliers].mean() / 2)
        return GivenPose(found.T_cam_w, len(rows), found.n_inliers, chi2, found.covariance, wide=False)

    def _healthy(self, n_inliers: int, n_matches: int, chi2: float) -> bool:
        return find_lack_of_support(n_inliers, n_matches, chi2, self._config.health) is None

    # --- over a gap

    def _relocalise(self, view: View, features: Features) -> GivenPose | Track | Failure:
        """Wide matching with several frames before the gap; believed when a second frame beyond it agrees."""
        index, before = view.index, self._beyond
        # The last one, and others spread over the keyframes before it: the wider they stand, the better is depth known.
        keyframes = [k for k in self._map.frames[:-1] if k in self.submap.keyframes][1 - SEED_KEYFRAMES :]
        spread = np.linspace(0, len(keyframes) - 1, min(GAP_FRAMES - 1, len(keyframes))).astype(np.int64)
        frames = [*(keyframes[i] for i in spread.tolist()), *self._map.frames[-1:]]
        self._map.add(index, features, self._matches(features, frames))
        rows = self._map.rows_with_track(index)
        found = relocalise_across_gap(
            self._map.views(index, rows, frames),
            features.uv_rect_px[rows],
            features.sigma_px[rows],
            self.submap.K,
            self._size_px,
            self._adjuster,
            self._config.seed,
        )
        wide = self._judge(found)
        if not isinstance(wide, Failure):
            refused = self._refuse_look_alike(wide, features, frames)
            wide = wide if refused is None else refused
        if isinstance(wide, Failure) and wide.reason is FailureReason.LOOK_ALIKE:
            self._map.drop(index)
            return wide
        if isinstance(wide, Failure):
            step = self._small_step(view, found) if isinstance(found, GapPose) else None
            if step is None:
                self._map.drop(index)
            return wide if step is None else step
        self._beyond = _Beyond(features, rows[wide.inliers], wide, view)
        if before is None:
            return Failure(FailureReason.UNCONFIRMED, "the first frame beyond a gap", wide.numbers)
        matches = self._auxiliary.match_wide(before.features, features).index
        share = confirmed_share(before, self._beyond, matches, self.submap.K)
        if share < CONFIRMING_SHARE:
            self._map.drop(before.view.index)
            return Failure(
                FailureReason.UNCONFIRMED, f"{share:.0%} of two frames confirm the gap relocalisation", wide.numbers
            )
        self._map.put(before.view.index, self.reference_id, before.pose.T_cam_submap)
        self._relocalised = index
        self._confirmed = before, before.pose.T_cam_submap @ se3.inverse(wide.T_cam_submap)
        n_inliers = int(wide.inliers.sum())
        return GivenPose(wide.T_cam_submap, len(rows), n_inliers, wide.chi2, wide.covariance, wide=True)

    def _small_step(self, view: View, found: GapPose) -> Track | None:
        """Let the submap's landmarks decide where the auxiliary front end's matches alone do not, if the camera has
        hardly moved.

        A camera in the hand turns fast and moves little: few of the auxiliary front end's points have parallax enough
        to keep the scale, but the landmarks that it still sees have, and a step that is small against their depth
        changes nothing in that. (Across a long one, landmarks of two or three views would carry their errors over as
        scale.)
        """
        track = self._live.track_near(view, found.T_cam_submap)
        if isinstance(track, Failure) or not self._healthy(track.n_inliers, track.n_matches, track.chi2):
            return None
        last = se3.inverse(self._map.T_cam_submap(self._map.frames[-1]))[:3, 3]
        step = float(np.linalg.norm(se3.inverse(track.T_cam_submap)[:3, 3] - last))
        ids = track.landmark_ids[track.landmark_ids >= 0]
        _, depth = project_points(self.submap.K, track.T_cam_submap, self.submap.landmarks["xyz_mu"][ids])
        if not step < SMALL_STEP * float(np.median(depth)):
            return None
        self._live.take(track)
        return track

    def _refuse_look_alike(self, wide: GapPose, features: Features, frames: list[int]) -> Failure | None:
        """Return why a gap relocalisation is not believed, if another pose explains nearly as much."""
        if self._doubt is not None:
            return self._doubt
        last = frames[-1]
        rows = self._map.rows_with_track(last)
        xyz, good = triangulate(self._map.views(last, rows, frames), self.submap.K)
        self._doubt = refuse_look_alike(
            self._auxiliary,
            self._map.features(last).descriptors[rows[good]],
            xyz[good],
            features,
            wide.T_cam_submap,
            self.submap.K,
            self._size_px,
            self._config.seed,
        )
        return self._doubt

    def _judge(self, wide: GapPose | Failure) -> GapPose | Failure:
        """Hold a gap relocalisation to what health asks of a track, and to the scale that it must not lose."""
        limit = self._config.linking.max_gap_scale_sigma
        if isinstance(wide, Failure):
            return wide
        lack = find_lack_of_support(int(wide.inliers.sum()), len(wide.inliers), wide.chi2, self._config.health)
        if lack is not None:
            return replace(lack, numbers=wide.numbers)
        if wide.scale_sigma > limit:
            return Failure(FailureReason.SCALE, f"the scale beyond is known to {wide.scale_sigma:.1%}", wide.numbers)
        return wide
