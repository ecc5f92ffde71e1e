"""Poses by front ends of their own, frame to frame (paper, section III-B); keyframes and landmarks of the live one.

Features of another front end, found in the buffered images, are matched from frame to frame. Their points, triangulated
from the frames before, give each frame's pose by PnP. Under it the live front end finds the submap's landmarks, which
makes the frame a keyframe like any other. The factor graph solves for the pose anew.

With `tracks_live` the live front end tracks as far as it can, ten times as fast. Only the frames where it fails are
posed so. Its own features are matched wide first, since they exist already.

Where the next frame cannot be posed so (blur, black-out, frames that are missing) the odometry crosses the gap
(`frontends/gap/pose_finder.py`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from itertools import islice
from types import MappingProxyType

import numpy as np

from dualslam.core.bundle import BundleAdjuster
from dualslam.core.camera.base import Camera
from dualslam.core.config.settings import Config
from dualslam.core.decisions import Ruling
from dualslam.core.estimates import KeyframeReport
from dualslam.core.geometry import se3
from dualslam.core.interfaces import SubmapGraph
from dualslam.core.support import judge_track
from dualslam.core.types import Failure, FailureReason, FloatArray, Rival, Track, View
from dualslam.frontends.direct.warp import MIN_CONTRAST
from dualslam.frontends.gap.auxiliary_map import Auxiliary
from dualslam.frontends.gap.pose_finder import SEED_KEYFRAMES, Crossing, PoseFinder
from dualslam.frontends.tracking.tracker import GivenPose
from dualslam.frontends.tracking.visual import VisualFrontEnd
from dualslam.map.submap import Submap

Pose = GivenPose | Crossing | Track


class PnpOdometry:
    """Implements `VisualOdometry` on the live front end's submap with other front ends' poses.

    - `live`: of the submap.
    - `auxiliaries`: the quickest first: the next one is asked where those before it find no pose that is believed.
    - `camera`: as it was given.
    - `tracks_live`: the live front end poses the frames as long as it can by itself, and the others where it cannot.
    - `notes_rivals`, `expected`: as for `PoseFinder`.
    """

    def __init__(
        self,
        live: VisualFrontEnd,
        auxiliaries: Sequence[Auxiliary],
        route: Route,
        adjuster: BundleAdjuster,
        config: Config,
        camera: Camera,
        tracks_live: bool = False,
        notes_rivals: bool = False,
        expected: Mapping[int, FloatArray] = MappingProxyType({}),
    ) -> None:
        self.submap = live.submap
        self.graph = live.graph
        self._live = live
        self._route = route
        self._config = config
        self._finders = [
            PoseFinder(live, auxiliary, adjuster, config, camera, n < len(auxiliaries), notes_rivals, expected)
            for n, auxiliary in enumerate(auxiliaries, 1)
        ]
        self._min_features = config.tracking.min_inliers
        self._tracks_live = tracks_live
        self._following = False  # whether the last frame that was given has a pose
        self._relocalised: int | None = None  # the last frame that a gap relocalisation has posed
        self._crossing: Crossing | None = None  # of the frame that was given last
        self._rivals: tuple[Rival, ...] = ()

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

    @property
    def rivals(self) -> tuple[Rival, ...]:
        """Other answers to where the camera is beyond the gaps that were crossed, and the one at hand."""
        return self._rivals + self._finders[-1].rivals

    def confirmed(self) -> Track | None:
        """Return the first frame beyond a gap, when the one just given has confirmed it: where that one stands now."""
        if self._crossing is None or self._relocalised is None:
            return None
        T_confirming_submap = self._finders[0].T_cam_submap(self._relocalised)
        return self._crossing.first.track(self._crossing.T_first_confirming @ T_confirming_submap)

    def relative_pose(self, track: Track) -> FloatArray:
        """Return ``T_kf_cam``: the track's pose relative to the reference keyframe."""
        return self._live.relative_pose(track)

    def keyframe_due(self, track: Track) -> Ruling:
        """Whether the frame should become a keyframe: always after a gap relocalisation, held by its landmarks only."""
        if track.wide:
            return Ruling(True, detail="it lies beyond a gap")
        return self._live.keyframe_due(track)

    def go_by_known(self, track: Track) -> None:
        """Go by the keyframe of an earlier run that is there for a frame which would have become one."""
        self._live.go_by_known(track)

    def insert_keyframe(self, track: Track, in_haste: bool = False) -> KeyframeReport | Failure:
        """Make the frame a keyframe and solve the graph."""
        report = self._live.insert_keyframe(track, in_haste, pose_is_given=track.view.index == self._relocalised)
        if isinstance(report, Failure):
            return report
        self._note(track.view, track.view.index, se3.inverse(self.submap.T_submap_kf[track.view.index]))
        return report

    # --- its own

    def start_at(self, keyframe_id: int) -> None:
        """Begin at a keyframe of the submap: it and its neighbours in time give the first points."""
        self._live.start_at(keyframe_id)
        nearest = self.submap.keyframes_near(keyframe_id)[:SEED_KEYFRAMES]
        own = {view.index: view for view in self._route.own}
        for k in reversed(nearest):
            if k in own:
                self._note(own[k], k, se3.inverse(self.submap.T_submap_kf[k]))
        self._following = True

    def track(self, view: View) -> Track | Failure:
        """Pose a frame."""
        self._crossing = None
        if view.index in self.submap.keyframes:
            return self._meet(view)
        if self._live.lies_beyond_gap(view):
            self._following = False
        if self._tracks_live and self._following:
            track = judge_track(self._live.follow(view), self._config.health)
            if not isinstance(track, Failure):
                self._note(view, self.reference_id, track.T_cam_submap)
                return track
        lack = find_lack(view, self._min_features)
        if lack is not None:
            self._following = False
            return lack
        found = self._find(view)
        if isinstance(found, Failure):
            self._following = False
            return found
        if isinstance(found, Crossing):
            self._relocalised, self._crossing = view.index, found
            found = found.pose
        track = found if isinstance(found, Track) else self._live.track_at(view, found)
        self._note(view, self.reference_id, track.T_cam_submap)
        self._rivals = self.rivals
        self._end_gap()
        return track

    def _meet(self, view: View) -> Track:
        """Come to a frame that is a keyframe of the submap already."""
        T_cam_submap = se3.inverse(self.submap.T_submap_kf[view.index])
        self._note(view, view.index, T_cam_submap)
        self._end_gap()  # not by an ambiguous pose
        n = int((self.submap.landmark_of[view.index] >= 0).sum())
        return self._live.track_at(view, GivenPose(T_cam_submap, n, n, 1.0, np.zeros((se3.DOF, se3.DOF)), wide=False))

    def _end_gap(self) -> None:
        self._following = True
        for finder in self._finders:
            finder.end_gap()

    def _find(self, view: View) -> Pose | Failure:
        """Have the front ends pose a frame, one after the other until one can.

        Beyond a gap that the last of them finds ambiguous, the others are not asked: farther on they may not notice.
        """
        found: Pose | Failure = Failure(FailureReason.TOO_FEW_MATCHES)
        if self._finders[-1].doubt is not None:
            return self._finders[-1].doubt
        # Those that have posed the last frame follow first, before another goes far about; the first costs nothing.
        ready = [finder for n, finder in enumerate(self._finders) if n == 0 or finder.knows_last]
        for finder in ready if self._following else ():
            found = finder.follow(view, self._ahead(view, finder))
            if not isinstance(found, Failure):
                return found
        # Once the last has seen several poses, the others, which hardly see them, might go by another than it does.
        for finder in self._finders[-1:] if self._finders[-1].rivals else self._finders:
            has_waited, ahead = finder.waits, self._ahead(view, finder)
            if self._following and finder not in ready:
                found = finder.follow(view, ahead)
            if isinstance(found, Failure):
                found = finder.relocalise(view, ahead)
            if not isinstance(found, Failure):
                return found
            if finder.waits and not has_waited and not self._finders[-1].waits:
                return found  # the next frame may confirm it
        return found

    def _ahead(self, view: View, finder: PoseFinder) -> list[View]:
        """Return the views that a front end will be asked for next."""
        # The frame that confirms another is the last that is needed: the live front end goes on from there.
        is_last = self._tracks_live and finder.waits
        return [] if is_last else list(self._route.usable_after(view, self._min_features))

    def _note(self, view: View, reference_id: int, T_cam_submap: FloatArray) -> None:
        for finder in self._finders:
            finder.note(view, reference_id, T_cam_submap)


N_PREFETCHED = 1
"""Usable frames beyond the one at hand: a gap relocalisation takes two."""


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """Start of a walk, and the frames on its way."""

    own: Sequence[View]  # of the submap's own keyframes
    ahead: Sequence[View]  # in the order in which they will be given

    def usable_after(self, view: View, min_features: int) -> Iterator[View]:
        """Yield the next frames after one in which features can be found."""
        place = next((n for n, ahead in enumerate(self.ahead) if ahead.index == view.index), len(self.ahead))
        usable = (after for after in self.ahead[place + 1 :] if find_lack(after, min_features) is None)
        return islice(usable, N_PREFETCHED)


def find_lack(view: View, min_features: int) -> Failure | None:
    """Return why a frame is not worth a look; None if it is."""
    if len(view.features) < min_features:
        return Failure(FailureReason.NO_TEXTURE, f"{len(view.features)} features in the image")
    if view.image is not None and view.image.pixels()[::8, ::8].std() < MIN_CONTRAST:
        return Failure(FailureReason.NO_TEXTURE, "a blank image")
    return None
