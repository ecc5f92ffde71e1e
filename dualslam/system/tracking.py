"""One frame in a submap: it is posed, judged and recorded, and becomes a keyframe where one is due."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import cast

from dualslam.atlas.trajectory import FramePose
from dualslam.core.errors import SolverError
from dualslam.core.events import EventKind
from dualslam.core.interfaces import Seeker, VisualOdometry
from dualslam.core.types import Failure, FailureReason, Track, View
from dualslam.map.frame_observations import FrameObservations
from dualslam.system.camera.turns import with_turn_of_poses
from dualslam.system.places import PlaceKeeping
from dualslam.system.state import State


class Tracking:
    """Poses frames in a submap.

    Attributes
    ----------
    on_pose : callable or None
        Called with each frame's track as soon as it is posed.
    posed_at : float or None
        When the frame was posed, on the clock of `time.perf_counter`; whoever gives the next one sets it to None.
    """

    def __init__(self, state: State, places: PlaceKeeping) -> None:
        self.on_pose: Callable[[Track], None] | None = None
        self.posed_at: float | None = None
        self._state = state
        self._places = places
        self._last_pose: FramePose | None = None

    def track(self, odometry: VisualOdometry, view: View) -> Track | Failure:
        """Pose a frame, judge it, record it, and make it a keyframe where one is due."""
        state, submap = self._state, odometry.submap
        with state.record.timer.measure("tracking"):
            track = state.health.judge(odometry.track(view), view.index)
        if isinstance(track, Failure):
            return track
        self.posed_at = time.perf_counter()
        if self.on_pose is not None:
            self.on_pose(track)
        if not state.localises:
            submap.count_sightings(track)
        if track.wide:
            state.record.event(EventKind.GAP_RELOCALISED, view, submap.id, n_inliers=track.n_inliers)
        if state.localises:
            cast(Seeker, odometry).look_about()
        elif self._keyframe_due(odometry, track):
            parts = state.parts
            track = with_turn_of_poses(track, submap, self._last_pose, parts.shutter, parts.calibration.camera)
            if (failure := self._insert_keyframe(odometry, track)) is not None:
                return failure
        pose = FramePose(view.index, view.timestamp_s, submap.id, odometry.reference_id, odometry.relative_pose(track))
        seen = None if state.localises else FrameObservations.of(track.view.features, track.landmark_ids, submap.id)
        state.record.pose(pose, track.n_matches, track.n_inliers, seen, track.method)
        self._last_pose = pose
        with state.record.timer.measure("audit of images"):
            state.audit.take(submap, track)
        return track

    def _keyframe_due(self, odometry: VisualOdometry, track: Track) -> bool:
        """Whether a frame is to become a keyframe, now and in this submap."""
        state = self._state
        if not odometry.keyframe_due(track):
            odometry.go_by_known(track)
            return False
        if state.pace.puts_off(track.n_inliers, state.config.keyframes.weak_landmarks):
            return False
        return not self._places.keyframe_waits(odometry, track)

    def _insert_keyframe(self, odometry: VisualOdometry, track: Track) -> Failure | None:
        state, record = self._state, self._state.record
        try:
            with record.timer.measure("mapping"):
                report = odometry.insert_keyframe(track)
        except SolverError as error:
            return Failure(FailureReason.SOLVER, str(error))
        state.health.note_keyframe(report)
        if isinstance(report, Failure):
            return report
        record.timer.add("graph (in mapping)", report.graph_seconds)
        if report.rebuilt:
            record.event(EventKind.GRAPH_REBUILT, track.view, odometry.submap.id)
        return None
