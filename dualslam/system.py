"""The state machine of Dual-SLAM: one frame at a time, in the order in which the paper tells it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from dualslam.atlas import Atlas, Link, LinkKind
from dualslam.calibration import Calibration
from dualslam.carried_poses import carry_poses
from dualslam.core.config import Config
from dualslam.core.errors import SolverError
from dualslam.core.events import EventKind, EventLog
from dualslam.core.geometry import se3
from dualslam.core.interfaces import MapStarter, SubmapGraph, VisualOdometry
from dualslam.core.stage_timer import StageTimer
from dualslam.core.submap import Submap
from dualslam.core.types import Failure, FailureReason, FloatArray, Frame, FrameStatus, Start, Track, View
from dualslam.frame_buffer import FrameBuffer
from dualslam.frame_records import FrameResult, FrameRow
from dualslam.health import judge_track
from dualslam.linking import LinkEstimate
from dualslam.recovery import LinkAttempt, Relinker, walk_back
from dualslam.rollover import next_submap
from dualslam.trajectory import FramePose

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Components:
    """The parts that the composition root puts in: the system itself knows neither front end nor solver."""

    view_of: Callable[[Frame], View | Failure]
    new_starter: Callable[[], MapStarter]
    new_graph: Callable[[], SubmapGraph]
    new_odometry: Callable[[Submap, SubmapGraph], VisualOdometry]
    link: Callable[[Submap, Submap, int | None], LinkEstimate | Failure]
    calibration: Calibration

    @property
    def K(self) -> FloatArray:
        """(3, 3) intrinsics of the rectified pixels, as they are known now."""
        return self.calibration.camera.K


class System:
    """Monocular SLAM that keeps a lost map and starts the next.

    Attributes
    ----------
    atlas : Atlas
    rows : dict of int to FrameRow
        Every frame that was given to `step`, by its index.
    poses : dict of int to FramePose
    events : EventLog
    timer : StageTimer
    buffer : FrameBuffer
    """

    def __init__(self, components: Components, config: Config) -> None:
        self.atlas = Atlas()
        self.rows: dict[int, FrameRow] = {}
        self.poses: dict[int, FramePose] = {}
        self.events = EventLog()
        self.timer = StageTimer()
        self._parts = components
        self._config = config
        self.buffer = FrameBuffer(config.buffer.duration_s, config.buffer.max_mb)
        self._live: VisualOdometry | None = None
        self._starter = components.new_starter()
        self._lost: list[View] = []
        self._onsets: dict[int, int] = {}  # lost submaps that are not linked yet, and the frame of their loss

    @property
    def live(self) -> VisualOdometry | None:
        """The front end of the live submap; None while there is no map."""
        return self._live

    def step(self, frame: Frame) -> FrameResult:
        """Take one frame through the system.

        Parameters
        ----------
        frame : Frame
            Frames come in any steady order of time.

        Returns
        -------
        FrameResult
        """
        started = time.perf_counter()
        self.rows[frame.index] = FrameRow(frame.index, frame.timestamp_s, FrameStatus.INITIALISING)
        # 1. Features, into the buffer that a walk back in time will read.
        with self.timer.measure("features"):
            view = self._parts.view_of(frame)
        if isinstance(view, Failure):
            outcome: Track | Failure = self._unusable(frame, view)
        else:
            self.buffer.append(view)
            # 2. Without a live submap, try to start one; with one, track.
            outcome = self._initialise(view) if self._live is None else self._track(self._live, view)
        return self._result(frame, outcome, time.perf_counter() - started)

    def finish(self) -> None:
        """End the run: archive what is live."""
        if self._live is not None:
            self._archive(self._live, "end of sequence")

    # --- initialising

    def _initialise(self, view: View) -> Track | Failure:
        with self.timer.measure("initialisation"):
            start = self._starter.add(view)
        if isinstance(start, Failure):
            if start.reason is FailureReason.DOUBTFUL_INITIALISATION:
                self._event(EventKind.INITIALISATION_REFUSED, view, None, reason=start.detail, **start.numbers)
            return start
        return self._begin_submap(start, view)

    def _begin_submap(self, start: Start, view: View) -> Track | Failure:
        """Make a submap of a start, and pose the frames before and between by walking back in time over the buffer."""
        submap = Submap.from_start(start, len(self.atlas.submaps), self._parts.K)
        graph = self._parts.new_graph()
        try:
            with self.timer.measure("graph"):
                estimate = graph.update(submap)
        except SolverError as error:
            return Failure(FailureReason.SOLVER, str(error), start.numbers)
        submap.apply_estimate(estimate.keyframe_ids, estimate.T_submap_kf, estimate.landmark_ids, estimate.xyz_mu)
        kind = EventKind.INITIALISED if not self.atlas.submaps else EventKind.REINITIALISED
        self.atlas.add(submap)
        for k, keyframe in submap.keyframes.items():
            self._pose(FramePose(k, keyframe.timestamp_s, submap.id, k, np.eye(4)))
            row = self.rows[k]
            row.n_matches = row.n_inliers = int((submap.landmark_of[k] >= 0).sum())
        self._event(kind, view, submap.id, first_view=start.views[0].index, **start.numbers)
        with self.timer.measure("walk back"):
            self._walk_back(submap, graph, view)
        self._live = self._parts.new_odometry(submap, graph)
        self._live.start_at(view.index)
        self.buffer.thaw()
        n = int((submap.landmark_of[view.index] >= 0).sum())
        T_cam_submap = se3.inverse(submap.T_submap_kf[view.index])
        ids = submap.landmark_of[view.index]
        return Track(view, T_cam_submap, T_cam_submap, ids, n, n, n, 1.0, False, np.zeros((6, 6)))

    def _walk_back(self, submap: Submap, graph: SubmapGraph, newest: View) -> None:
        """Run the front end back in time: over the frames without a pose, then on into a lost submap, to link them."""
        started = time.perf_counter()
        recovery = self._config.recovery
        onsets = self._onsets if recovery.enabled else {}
        relinker = Relinker(self.atlas, submap, onsets, self._parts.link, recovery)
        unposed = {i for i, row in self.rows.items() if i not in self.poses}
        if onsets:
            self._event(EventKind.RECOVERY_STARTED, newest, submap.id, lost=sorted(onsets), **self.buffer.numbers)
        walker = self._parts.new_odometry(submap, graph)
        walker.start_at(newest.index)
        walked: list[FramePose] = []
        linked = None
        views = self._views_before(newest, submap, stop_at_posed=not onsets)
        for step in walk_back(walker, views, self._judge, relinker.keyframe_ids, recovery.max_leap_frames):
            walked.append(self._frame_pose(walker, step.view, step.track))
            if step.view.index in unposed:
                self._pose(walked[-1], step.track)
            if step.view.index not in submap.keyframes:
                continue
            for attempt in relinker.attempts(step.view.index):
                self._report_attempt(attempt, step.view, submap)
                if linked is None and not isinstance(attempt.result, Failure):
                    linked = attempt.old_id, attempt.result
            if linked is not None:
                break
        if linked is not None:
            self._fuse(linked[0], submap, linked[1], walked, newest, time.perf_counter() - started)

    def _views_before(self, newest: View, submap: Submap, stop_at_posed: bool) -> Iterator[View]:
        for view in self.buffer.backwards_from(newest.index):
            posed = self.poses.get(view.index)
            if stop_at_posed and posed is not None and posed.submap_id != submap.id:
                return
            yield view

    def _report_attempt(self, attempt: LinkAttempt, view: View, submap: Submap) -> None:
        result = attempt.result
        verdict = result.detail if isinstance(result, Failure) else "linked"
        reason = str(result.reason) if isinstance(result, Failure) else "linked"
        kind = EventKind.LINK_REFUSED if isinstance(result, Failure) else EventKind.RECOVERY_ATTEMPT
        self._event(
            kind,
            view,
            submap.id,
            old_submap=attempt.old_id,
            shared_keyframes=attempt.n_shared,
            verdict=verdict,
            reason=reason,
            **result.numbers,
        )

    def _fuse(
        self, old_id: int, submap: Submap, link: LinkEstimate, walked: list[FramePose], view: View, seconds: float
    ) -> None:
        """Join the two submaps by the link; frames of the old map's end take their pose from the new one."""
        agreeing = tuple(int(k) for k in link.agreeing_keyframes)
        self.atlas.link(Link(old_id, submap.id, link.S_old_new, link.covariance, LinkKind.RECOVERY, agreeing))
        self._event(
            EventKind.LINKED,
            view,
            submap.id,
            old_submap=old_id,
            matches=link.n_matches,
            inliers=link.n_inliers,
            agreeing_keyframes=[int(k) for k in link.agreeing_keyframes],
            change_point=link.change_point,
            seconds=seconds,
            **link.numbers,
        )
        handover = int(max(link.agreeing_keyframes))
        n_bypassed = 0
        for pose in walked:
            # The newest part of the old map, beyond the keyframes that agree, is by-passed.
            if pose.index <= handover or self.poses[pose.index].submap_id == submap.id:
                continue
            self._pose(pose)
            self.rows[pose.index].status = FrameStatus.BYPASSED
            n_bypassed += 1
        for pose in walked:
            if self._was_lost(pose.index, old_id):
                self.rows[pose.index].status = FrameStatus.RECOVERED
        self._onsets.pop(old_id)
        self._event(EventKind.FUSED, view, submap.id, old_submap=old_id, bypassed=n_bypassed)

    def _was_lost(self, index: int, old_id: int) -> bool:
        return (
            self.poses[index].submap_id != old_id
            and self.rows[index].status is FrameStatus.TRACKED
            and (index >= self._onsets[old_id])
        )

    def _judge(self, track: Track | Failure) -> Track | Failure:
        return judge_track(track, self._config.health)

    # --- tracking

    def _track(self, live: VisualOdometry, view: View) -> Track | Failure:
        track = self._track_with(live, view)
        if track:
            self._lost = []
            self.buffer.thaw()
            if live.reference_id == view.index and self._parts.calibration.is_due(live.submap):
                self._calibrate(live, view)
            if len(live.submap.keyframes) >= self._config.graph.max_keyframes:
                self._roll_over(live, view)
            return track
        assert isinstance(track, Failure)
        self._lost.append(view)
        self.rows[view.index].status = FrameStatus.LOST
        if len(self._lost) == 1:
            self.buffer.freeze()
        if len(self._lost) > self._config.tracking.max_lost_frames or track.reason is FailureReason.SOLVER:
            self._give_up(live, view, track)
        return track

    def _track_with(self, odometry: VisualOdometry, view: View) -> Track | Failure:
        """Pose a frame, judge it, record it, and make it a keyframe where one is due."""
        with self.timer.measure("tracking"):
            track = self._judge(odometry.track(view))
        if isinstance(track, Failure):
            return track
        if track.wide:
            self._event(EventKind.RELOCALISED, view, odometry.submap.id, n_inliers=track.n_inliers)
        if odometry.keyframe_due(track):
            try:
                with self.timer.measure("mapping"):
                    report = odometry.insert_keyframe(track)
            except SolverError as error:
                return Failure(FailureReason.SOLVER, str(error))
            self.timer.add("graph (in mapping)", report.estimate.seconds)
            if report.estimate.rebuilt:
                self._event(EventKind.GRAPH_REBUILT, view, odometry.submap.id)
        self._pose(self._frame_pose(odometry, view, track), track)
        return track

    @staticmethod
    def _frame_pose(odometry: VisualOdometry, view: View, track: Track) -> FramePose:
        return FramePose(
            view.index, view.timestamp_s, odometry.submap.id, odometry.reference_id, odometry.relative_pose(track)
        )

    def _calibrate(self, live: VisualOdometry, view: View) -> None:
        """Ask the submap about its camera. Where the answer is clear, submap, graph and buffer change to it."""
        calibration = self._parts.calibration
        with self.timer.measure("calibration"):
            refined = calibration.refine(live.submap, self._parts.new_graph())
            if isinstance(refined, Failure):
                self._event(EventKind.CALIBRATION_KEPT, view, live.submap.id, reason=refined.detail, **refined.numbers)
                return
            live.adopt(refined.graph)
            self.buffer.map(calibration.rectified)
            for pose in carry_poses(self.poses.values(), refined.before, live.submap):
                self.poses[pose.index] = pose
        self._event(EventKind.CALIBRATED, view, live.submap.id, **refined.numbers)

    # --- failure

    def _give_up(self, live: VisualOdometry, view: View, failure: Failure) -> None:
        """Declare the track failed: archive the submap whole, and start the next from the frames since the loss."""
        self._event(
            EventKind.FAILED,
            view,
            live.submap.id,
            reason=str(failure.reason),
            detail=failure.detail,
            lost_since=self._lost[0].index,
            **failure.numbers,
        )
        self._archive(live, "track lost")
        self._onsets[live.submap.id] = self._lost[0].index
        self._live = None
        self._starter = self._parts.new_starter()
        for lost in self._lost:
            self._starter.collect(lost)
        self._lost = []

    def _archive(self, live: VisualOdometry, why: str) -> None:
        submap = live.submap
        try:
            final = live.graph.full_estimate(submap)
            submap.apply_estimate(final.keyframe_ids, final.T_submap_kf, final.landmark_ids, final.xyz_mu)
        except SolverError:
            log.warning("submap %d is archived as it stands: its graph gives no estimate", submap.id)
        # A submap that rolled over and was lost at once has no frame of its own: its newest keyframe stands for it.
        last = max([p.index for p in self.poses.values() if p.submap_id == submap.id], default=max(submap.keyframes))
        self.events.add(
            EventKind.ARCHIVED,
            last,
            self.rows[last].timestamp_s,
            submap.id,
            why=why,
            keyframes=len(submap.keyframes),
            landmarks=int(submap.landmarks["alive"].sum()),
        )

    def _unusable(self, frame: Frame, failure: Failure) -> Failure:
        """A frame without image or features: it has its row, and tracking goes on with the next."""
        self.rows[frame.index].status = (
            FrameStatus.UNREADABLE if failure.reason is FailureReason.UNREADABLE else FrameStatus.LOST
        )
        if failure.reason is FailureReason.UNREADABLE:
            self.events.add(EventKind.UNREADABLE, frame.index, frame.timestamp_s, None, detail=failure.detail)
        return failure

    # --- a submap that is full

    def _roll_over(self, live: VisualOdometry, view: View) -> None:
        """Go on in a new submap that shares its first keyframes with the full one: exact link, no failure."""
        submap = next_submap(live.submap, len(self.atlas.submaps), self._config.graph.rollover_keyframes)
        graph = self._parts.new_graph()
        try:
            graph.rebuild(submap)
        except SolverError as error:
            log.warning("submap %d stays open beyond its cap: %s", live.submap.id, error)
            return
        self.atlas.add(submap)
        self.atlas.link(Link(live.submap.id, submap.id, np.eye(4), np.zeros((7, 7)), LinkKind.ROLLOVER))
        self._event(EventKind.ROLLED_OVER, view, submap.id, from_submap=live.submap.id)
        self._archive(live, "full")
        self._live = self._parts.new_odometry(submap, graph)
        self._live.start_at(list(submap.keyframes)[-1])

    # --- records

    def _pose(self, pose: FramePose, track: Track | None = None) -> None:
        self.poses[pose.index] = pose
        row = self.rows[pose.index]
        row.status, row.submap_id = FrameStatus.TRACKED, pose.submap_id
        if track is not None:
            row.n_matches, row.n_inliers = track.n_matches, track.n_inliers

    def _event(self, kind: EventKind, view: View, submap_id: int | None = None, **data: Any) -> None:
        self.events.add(kind, view.index, view.timestamp_s, submap_id, **data)

    def _result(self, frame: Frame, outcome: Track | Failure, seconds: float) -> FrameResult:
        row = self.rows[frame.index]
        row.latency_ms = 1000 * seconds
        pose = self.poses.get(frame.index)
        T_submap_cam = None
        if pose is not None:
            T_submap_cam = self.atlas.submaps[pose.submap_id].resolve_anchor(pose.keyframe_id, pose.T_kf_cam)
        failure = outcome if isinstance(outcome, Failure) else None
        return FrameResult(
            frame.index, row.status, row.submap_id, T_submap_cam, row.n_matches, row.n_inliers, row.latency_ms, failure
        )
