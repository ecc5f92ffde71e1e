"""One frame in a submap: it is posed, judged and recorded, and becomes a keyframe where one is due."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import cast

from dualslam.atlas.trajectory import FramePose
from dualslam.core.decisions import Decision, DecisionKind
from dualslam.core.errors import SolverError
from dualslam.core.events import EventKind
from dualslam.core.interfaces import Seeker, VisualOdometry
from dualslam.core.support import support_gates
from dualslam.core.types import Failure, FailureReason, FrameMethod, Track, View
from dualslam.map.frame_observations import FrameObservations
from dualslam.system.camera.shutter_watch import with_turn_of_poses
from dualslam.system.places import PlaceKeeping
from dualslam.system.state import State


class Tracking:
    """Poses frames in a submap.

    - `on_pose`: called with each frame's track as soon as it is posed.
    - `posed_at`: when the frame was posed, on the clock of `time.perf_counter`; None before that.
    """

    def __init__(self, state: State, places: PlaceKeeping) -> None:
        self.on_pose: Callable[[Track], None] | None = None
        self.posed_at: float | None = None
        self._state = state
        self._places = places
        self._last_pose: FramePose | None = None
        self._decisions = state.record.events.decisions

    def track(self, odometry: VisualOdometry, view: View) -> Track | Failure:
        """Pose a frame, judge it, record it, and make it a keyframe where one is due."""
        state, submap = self._state, odometry.submap
        with state.record.timer.measure("tracking"):
            track = state.health.judge(odometry.track(view), view.index)
        if self._decisions.is_open:
            self._decisions.note(self._frame_decision(view, submap.id, track))
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
        if track.method is not FrameMethod.DIRECT:  # a pixel matcher has compared the images, and knows their blur
            with state.record.timer.measure("audit of images"):
                state.audit.take(submap, track)
        return track

    def _keyframe_due(self, odometry: VisualOdometry, track: Track) -> bool:
        """Whether a frame is to become a keyframe, now and in this submap."""
        state, ruling = self._state, odometry.keyframe_due(track)
        is_made, detail = False, ruling.detail
        if not ruling:
            odometry.go_by_known(track)
        elif state.pace.puts_off(track.n_inliers, state.config.keyframes.weak_landmarks):
            detail = "put off to a later frame: frames or the graph are late"
        elif self._places.keyframe_waits(odometry, track):
            detail = "a map of an earlier run may have the place"
        else:
            is_made = True
        if self._decisions.is_open:
            at = track.view.index, DecisionKind.KEYFRAME, is_made, odometry.submap.id
            self._decisions.note(Decision(*at, ruling.gates, detail=detail))
        return is_made

    def _frame_decision(self, view: View, submap_id: int, track: Track | Failure) -> Decision:
        """Return the decision whether the map explains a frame; the early signs of trouble are among its data."""
        health = self._state.health.newest
        signs = {"signs": [] if health is None else [str(sign) for sign in health.signs]}
        if isinstance(track, Failure):
            refused = Decision.refused(view.index, DecisionKind.FRAME, submap_id, track)
            return replace(refused, data=refused.data | signs)
        gates = support_gates(track.n_inliers, track.n_matches, track.chi2, self._state.config.health)
        data = {"method": str(track.method), "in_view": len(track.visible_ids), "matches": track.n_matches} | signs
        return Decision(view.index, DecisionKind.FRAME, True, submap_id, gates, data=data)

    def _insert_keyframe(self, odometry: VisualOdometry, track: Track) -> Failure | None:
        state, record = self._state, self._state.record
        try:
            with record.timer.measure("mapping"):
                report = odometry.insert_keyframe(track, in_haste=state.pace.behind)
        except SolverError as error:
            return Failure(FailureReason.SOLVER, str(error))
        state.health.note_keyframe(report)
        if isinstance(report, Failure):
            self._decisions.note(Decision.refused(track.view.index, DecisionKind.KEYFRAME, odometry.submap.id, report))
            return report
        record.timer.add("graph (in mapping)", report.graph_seconds)
        if report.rebuilt:
            record.event(EventKind.GRAPH_REBUILT, track.view, odometry.submap.id)
        return None
