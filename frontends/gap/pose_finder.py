"""Poses of frames by one front end's features: from frame to frame, and across a gap.

Its features are matched by themselves. Their points, triangulated from the frames before, give a frame's pose by PnP.
Across a gap a frame is matched with several frames before it. Its pose is accepted once a second frame beyond the gap,
posed by itself, sees the same points where they should be. No other pose may explain nearly as much.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from dualslam.core.bundle import BundleAdjuster
from dualslam.core.camera.base import Camera
from dualslam.core.config.settings import Config
from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import project_points
from dualslam.core.support import find_lack_of_support, judge_track
from dualslam.core.types import Failure, FailureReason, Features, FloatArray, IntArray, Matches, Rival, Track, View
from dualslam.frontends.gap.auxiliary_map import Auxiliary, AuxiliaryMap, triangulate
from dualslam.frontends.gap.consensus import CONFIRMING_SHARE, BeyondGap, are_no_copies, confirmed_share
from dualslam.frontends.gap.relocalisation import GapPose, relocalise_across_gap
from dualslam.frontends.gap.second_pose import Sight, find_other_poses, match_under, refuse_look_alike
from dualslam.frontends.gap.uncertainty import SMALL_STEP
from dualslam.frontends.tracking.resection import estimate_pose
from dualslam.frontends.tracking.tracker import GivenPose
from dualslam.frontends.tracking.visual import VisualFrontEnd
from dualslam.map.submap import NO_LANDMARK

FOLLOW_FRAMES = 2  # frames that the next one is matched with
POINT_FRAMES = 6  # frames that a point is triangulated from
GAP_FRAMES = 5  # frames before a gap that those beyond it are matched with
SEED_KEYFRAMES = 8  # the latest keyframes, that the walk starts from and that those before a gap are chosen from


@dataclass(frozen=True, slots=True, eq=False)
class FrameBeyond(BeyondGap):
    """A frame beyond a gap, with its view."""

    view: View

    def track(self, T_cam_submap: FloatArray) -> Track:
        """Return the frame with a pose that it was given in the end, and no landmarks."""
        wide, ids = self.pose, np.full(len(self.view.features), NO_LANDMARK, np.int64)
        n, n_inliers = len(wide.inliers), int(wide.inliers.sum())
        numbers = (n, n_inliers, wide.chi2)
        none = np.zeros(0, np.int64)
        return Track(self.view, T_cam_submap, T_cam_submap, ids, none, *numbers, wide=True, covariance=wide.covariance)


@dataclass(frozen=True, slots=True, eq=False)
class Crossing:
    """A gap that is crossed."""

    pose: GivenPose  # of the frame beyond it that confirms the first
    first: FrameBeyond
    T_first_confirming: FloatArray  # (4, 4)


class PoseFinder:
    """Finds poses by a front end's features, in a submap of which it reads the keyframes' poses.

    - `live`: of the submap.
    - `camera`: as it was given.
    - `is_short_cut`: there are other, better features, to which is left what these leave in doubt beyond a gap. Binary
      descriptors know a thing again only from about the same side: past parked cars the right pose had 16 to 46 points
      of 186 to 294. Without repetition no second pose has the required 12.
    - `notes_rivals`: whether an ambiguous pose beyond a gap is used, and left to the caller to decide, or refused.
    - `expected` (mapping of int to (4, 4)): ``T_cam_submap`` of frames beyond the gap, where it is known which of
      several like places they show.
    """

    def __init__(
        self,
        live: VisualFrontEnd,
        auxiliary: Auxiliary,
        adjuster: BundleAdjuster,
        config: Config,
        camera: Camera,
        is_short_cut: bool,
        notes_rivals: bool,
        expected: Mapping[int, FloatArray],
    ) -> None:
        self._live = live
        self._submap = live.submap
        self._frontend = auxiliary.frontend
        self._features_of = auxiliary.features
        self._adjuster = adjuster
        self._config = config
        self._min_features = config.tracking.min_inliers
        self._camera = camera
        self._is_short_cut = is_short_cut
        self._notes_rivals = notes_rivals and not is_short_cut
        self._expected = expected
        self._rivals: list[Rival] = []  # beyond the gap at hand
        self._map = AuxiliaryMap(live.submap)
        self._pending: dict[int, View] = {}  # posed, but without features of this front end as yet
        self._doubt: Failure | None = None
        self._beyond: FrameBeyond | None = None  # the last frame beyond a gap, until another confirms it

    @property
    def knows_last(self) -> bool:
        """Whether it has features of the last frame that has a pose."""
        return bool(self._map.posed) and self._map.has_features(self._map.posed[-1])

    @property
    def waits(self) -> bool:
        """Whether a frame beyond a gap has a pose that the next one may confirm."""
        return self._beyond is not None

    @property
    def doubt(self) -> Failure | None:
        """Repeated structure found beyond the current gap. These features do not cross it any more."""
        return self._doubt

    @property
    def rivals(self) -> tuple[Rival, ...]:
        """Other answers for frames beyond the gap at hand: they stay for as long as it does."""
        return tuple(self._rivals)

    def T_cam_submap(self, index: int) -> FloatArray:
        """Return where a frame stands by the submap's current poses."""
        return self._map.T_cam_submap(index)

    def note(self, view: View, reference_id: int, T_cam_submap: FloatArray) -> None:
        """Take in where a frame stands; its features are found when they are needed."""
        self._map.put(view.index, reference_id, T_cam_submap)
        if not self._map.has_features(view.index):
            self._pending[view.index] = view

    def end_gap(self) -> None:
        """Forget the gap that was crossed, and frames that no later one will be compared with."""
        self._beyond, self._doubt = None, None
        self._rivals = []
        for index in self._map.frames[:-POINT_FRAMES]:
            if index not in self._submap.keyframes:
                self._map.drop(index)

    def _look_at(self, view: View, needed: list[int], ahead: Iterable[View]) -> Features | Failure:
        """Find the features of a frame, and of those that it will be matched with."""
        pending = [self._pending.pop(index) for index in needed if index in self._pending]
        self._features_of.prefetch([*pending, view, *ahead])
        for other in pending:
            features = self._features(other)
            if isinstance(features, Failure):
                self._map.drop(other.index)
            else:
                self._map.add(other.index, features, self._matches(features, self._map.frames[-GAP_FRAMES:]))
        return self._features(view)

    def _features(self, view: View) -> Features | Failure:
        features = self._features_of.of(view)
        if not isinstance(features, Failure) and len(features) < self._min_features:
            return Failure(FailureReason.NO_TEXTURE, f"{len(features)} features of {self._frontend.name} in the image")
        return features

    def _matches(self, features: Features, frames: list[int]) -> dict[int, Matches]:
        return {k: self._frontend.match_wide(self._map.features(k), features) for k in reversed(frames)}

    # --- from frame to frame

    def follow(self, view: View, ahead: Iterable[View]) -> GivenPose | Failure:
        """Pose a frame that is next to the last one: PnP against the points of the frames before.

        `ahead`: the views that come after it.
        """
        posed = self._map.posed
        keyframes = [k for k in posed if k in self._submap.keyframes][-SEED_KEYFRAMES:]
        near = list(dict.fromkeys([*keyframes, *posed[-FOLLOW_FRAMES:]]))
        # As many as points are made of have their features where a gap was crossed just now: the rest would add little.
        is_known = sum(self._map.has_features(index) for index in near) >= POINT_FRAMES
        features = self._look_at(view, posed[-FOLLOW_FRAMES:] if is_known else near, ahead)
        if isinstance(features, Failure):
            return features
        frames = self._map.frames[-POINT_FRAMES:]
        self._map.add(view.index, features, self._matches(features, frames[-FOLLOW_FRAMES:]))
        rows = self._map.rows_with_track(view.index)
        xyz, good = triangulate(self._map.views(view.index, rows, frames), self._submap.K)
        pose = self._pnp(features, rows[good], xyz[good])
        if isinstance(pose, Failure):
            self._map.drop(view.index)
        return pose

    def _pnp(self, features: Features, rows: IntArray, xyz: FloatArray) -> GivenPose | Failure:
        minimum = self._config.health.min_inliers
        if len(rows) < minimum:
            return Failure(FailureReason.TOO_FEW_MATCHES, f"{len(rows)} points of {self._frontend.name}")
        uv, sigma = features.uv_rect_px[rows], features.sigma_px[rows]
        found = estimate_pose(
            self._submap.K, self._camera.size_px, uv, xyz, sigma, self._config.seed, min_inliers=minimum
        )
        if isinstance(found, Failure):
            return found
        chi2 = float(found.chi2[found.inliers].mean() / 2)
        return GivenPose(found.T_cam_w, len(rows), found.n_inliers, chi2, found.covariance, wide=False)

    # --- across a gap

    def relocalise(self, view: View, ahead: Iterable[View]) -> Crossing | Track | Failure:
        """Wide matching with several frames before the gap; believed when a second frame beyond it agrees."""
        if self._doubt is None and self._is_short_cut and self._expected:
            self._doubt = Failure(FailureReason.LOOK_ALIKE, "it took other features to tell several poses apart")
        if self._doubt is not None:
            return self._doubt
        index, before = view.index, self._beyond
        frames = self._frames_before_gap()
        features = self._look_at(view, frames, ahead)
        if isinstance(features, Failure):
            return features
        frames = [k for k in frames if self._map.has_features(k)]
        T_expected = self._expected.get(index)
        if T_expected is None and self._rivals and before is not None:
            T_expected = before.pose.T_cam_submap  # of several like places the one that waits to be confirmed
        if T_expected is None:
            self._map.add(index, features, self._matches(features, frames))
        else:
            self._map.add(index, features, self._matches_under(T_expected, features, frames))
        rows = self._map.rows_with_track(index)
        found = relocalise_across_gap(
            self._map.views(index, rows, frames),
            features.uv_rect_px[rows],
            features.sigma_px[rows],
            self._submap.K,
            self._camera.size_px,
            self._adjuster,
            self._config.seed,
        )
        wide = self._judge(view, found)
        if not isinstance(wide, Failure):
            self._doubt = self._refuse_look_alike(view, wide, features, frames)
            wide = wide if self._doubt is None else self._doubt
        if isinstance(wide, Failure):
            step = None
            may_be_small = not (self._is_short_cut or self._rivals or wide.reason is FailureReason.LOOK_ALIKE)
            if isinstance(found, GapPose) and may_be_small:
                step = self._small_step(view, found, frames[-1])
            if step is None:
                self._map.drop(index)
            return wide if step is None else step
        self._beyond = FrameBeyond(features, rows[wide.inliers], wide, view)
        if before is None:
            return Failure(FailureReason.UNCONFIRMED, "the first frame beyond a gap", wide.numbers)
        matches = self._frontend.match_wide(before.features, features).index
        if self._rivals:
            matches = matches[are_no_copies(before, self._beyond, matches, self._rivals, self._submap.K)]
        share = confirmed_share(before, self._beyond, matches, self._submap.K)
        if share < CONFIRMING_SHARE:
            self._map.drop(before.view.index)
            if self._rivals:
                detail = "beyond the gap several poses are alike, and two frames do not confirm one of them"
                self._doubt = Failure(FailureReason.LOOK_ALIKE, detail, wide.numbers)
                return self._doubt
            return Failure(
                FailureReason.UNCONFIRMED, f"{share:.0%} of two frames confirm the gap relocalisation", wide.numbers
            )
        self._map.put(before.view.index, self._live.reference_id, before.pose.T_cam_submap)
        return Crossing(_given(wide), before, before.pose.T_cam_submap @ se3.inverse(wide.T_cam_submap))

    def _frames_before_gap(self) -> list[int]:
        """Return the last frame, and others spread widely over the keyframes before it, which know depth the better."""
        posed = self._map.posed
        keyframes = [k for k in posed[:-1] if k in self._submap.keyframes][1 - SEED_KEYFRAMES :]
        spread = np.linspace(0, len(keyframes) - 1, min(GAP_FRAMES - 1, len(keyframes))).astype(np.int64)
        return [*(keyframes[i] for i in spread.tolist()), *posed[-1:]]

    def _small_step(self, view: View, found: GapPose, last: int) -> Track | None:
        """Let the submap's landmarks decide where the auxiliary matches alone do not, if the camera has hardly moved.

        A hand-held camera turns fast and moves little: few of the matched points have the parallax to keep the scale. A
        step that is small against the depth of the landmarks in view does not change it.
        """
        track = judge_track(self._live.track_near(view, found.T_cam_submap), self._config.health)
        if isinstance(track, Failure):
            return None
        place = se3.translation(se3.inverse(self._map.T_cam_submap(last)))
        step = float(np.linalg.norm(se3.translation(se3.inverse(track.T_cam_submap)) - place))
        ids = track.seen_ids
        _, depth = project_points(self._submap.K, track.T_cam_submap, self._submap.landmarks["xyz_mu"][ids])
        if not step < SMALL_STEP * float(np.median(depth)):
            return None
        self._live.take(track)
        return track

    def _refuse_look_alike(self, view: View, wide: GapPose, features: Features, frames: list[int]) -> Failure | None:
        """Return why a gap relocalisation is not believed, if another pose explains nearly as much and is not noted."""
        sight, _ = self._sight(frames[-1], frames, features)
        T, seed = wide.T_cam_submap, self._config.seed
        if not self._notes_rivals:
            return refuse_look_alike(sight, T, seed, any_is_doubt=self._is_short_cut)
        others = find_other_poses(sight, T, seed)
        if others and others[0].makes_doubtful:
            self._rivals += [Rival(view.index, other.T_cam_w, T) for other in others]
        return None

    def _sight(self, index: int, frames: list[int], features: Features) -> tuple[Sight, IntArray]:
        """Return the points of a frame before the gap that several show, and which of its features (N,) are theirs."""
        rows = self._map.rows_with_track(index)
        xyz, good = triangulate(self._map.views(index, rows, frames), self._submap.K)
        known = self._map.features(index).descriptors[rows[good]]
        return Sight(self._frontend, known, xyz[good], features, self._submap.K, self._camera), rows[good]

    def _matches_under(self, T_cam_submap: FloatArray, features: Features, frames: list[int]) -> dict[int, Matches]:
        """Match a frame with others where the points that these see should be."""
        matches = {}
        for k in reversed(frames):
            sight, rows = self._sight(k, frames, features)
            found = match_under(sight, T_cam_submap)
            matches[k] = Matches(np.column_stack([rows[found.index[:, 0]], found.index[:, 1]]), found.distance)
        return matches

    def _judge(self, view: View, wide: GapPose | Failure) -> GapPose | Failure:
        """Hold a gap relocalisation to what health asks of a track, and to the scale that it must not lose."""
        if isinstance(wide, Failure):
            return wide
        lack = find_lack_of_support(int(wide.inliers.sum()), len(wide.inliers), wide.chi2, self._config.health)
        if lack is not None:
            return replace(lack, numbers=wide.numbers)
        if wide.scale_sigma > self._config.linking.max_gap_scale_sigma and not self._holds_scale(view, wide):
            return Failure(FailureReason.SCALE, f"the scale beyond is known to {wide.scale_sigma:.1%}", wide.numbers)
        return wide

    def _holds_scale(self, view: View, wide: GapPose) -> bool:
        """Whether the landmarks found again in the image hold the scale where the wide matches leave it open.

        If they are too few, reverse tracking finds no link and is repeated with other features; after the last ones
        there is no other try.
        """
        if not self._is_short_cut:
            return False
        return self._live.scale_sigma_at(view, _given(wide)) < self._config.linking.max_gap_scale_sigma


def _given(wide: GapPose) -> GivenPose:
    n_inliers = int(wide.inliers.sum())
    return GivenPose(wide.T_cam_submap, len(wide.inliers), n_inliers, wide.chi2, wide.covariance, wide=True)
