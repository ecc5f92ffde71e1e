"""The state machine of Dual-SLAM: one frame at a time, in the order in which the paper tells it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from dualslam.atlas import Atlas, Link, LinkKind
from dualslam.calibration import Calibration
from dualslam.carried_poses import carry_poses
from dualslam.core.config import Config
from dualslam.core.events import EventKind, EventLog
from dualslam.core.interfaces import MapStarter, SubmapGraph, VisualOdometry
from dualslam.core.stage_timer import StageTimer
from dualslam.core.submap import Submap
from dualslam.core.types import Failure, FailureReason, FloatArray, Frame, FrameStatus, Start, Track, View
from dualslam.frame_buffer import FrameBuffer
from dualslam.health import judge_track
from dualslam.rollover import next_submap
from dualslam.trajectory import FramePose


@dataclass(frozen=True, slots=True)
class Components:
    """The parts that the composition root puts in: the system itself knows neither front end nor solver."""

    view_of: Callable[[Frame], View | Failure]
    new_starter: Callable[[], MapStarter]
    new_graph: Callable[[], SubmapGraph]
    new_odometry: Callable[[Submap, SubmapGraph], VisualOdometry]
    calibration: Calibration

    @property
    def K(self) -> FloatArray:
        """(3, 3) intrinsics of the rectified pixels, as they are known now."""
        return self.calibration.camera.K


@dataclass(slots=True)
class FrameRow:
    """What became of one frame so far; a later walk back in time may still pose it."""

    index: int
    timestamp_s: float
    status: FrameStatus
    submap_id: int | None = None
    n_matches: int = 0
    n_inliers: int = 0
    latency_ms: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """What one step found out about its frame.

    Attributes
    ----------
    T_submap_cam : (4, 4) float64 or None
        In the unit and frame of submap `submap_id`, as known now; later frames refine it.
    failure : Failure or None
        Why the frame has no pose.
    """

    index: int
    status: FrameStatus
    submap_id: int | None
    T_submap_cam: FloatArray | None
    n_matches: int
    n_inliers: int
    latency_ms: float
    failure: Failure | None


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
    """

    def __init__(self, components: Components, config: Config) -> None:
        self.atlas = Atlas()
        self.rows: dict[int, FrameRow] = {}
        self.poses: dict[int, FramePose] = {}
        self.events = EventLog()
        self.timer = StageTimer()
        self._parts = components
        self._config = config
        self._buffer = FrameBuffer(config.buffer.duration_s, config.buffer.max_views)
        self._live: VisualOdometry | None = None
        self._starter = components.new_starter()
        self._lost: list[View] = []

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
            self._buffer.append(view)
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
                self._event(EventKind.INITIALISATION_REFUSED, view, reason=start.detail, **start.numbers)
            return start
        return self._begin_submap(start, view)

    def _begin_submap(self, start: Start, view: View) -> Track | Failure:
        """Make a submap of a start, and pose the frames before and between by walking back in time over the buffer."""
        submap = Submap.from_start(start, len(self.atlas.submaps), self._parts.K)
        graph = self._parts.new_graph()
        with self.timer.measure("graph"):
            estimate = graph.update(submap)
        submap.apply_estimate(estimate.keyframe_ids, estimate.T_submap_kf, estimate.landmark_ids, estimate.xyz_mu)
        kind = EventKind.INITIALISED if not self.atlas.submaps else EventKind.REINITIALISED
        self.atlas.add(submap)
        for k, keyframe in submap.keyframes.items():
            self._pose(FramePose(k, keyframe.timestamp_s, submap.id, k, np.eye(4)))
        self._event(kind, view, submap.id, first_view=start.views[0].index, **start.numbers)
        self._walk_back(submap, graph, view)
        self._live = self._parts.new_odometry(submap, graph)
        self._live.start_at(view.index)
        self._buffer.thaw()
        n = int((submap.landmark_of[view.index] >= 0).sum())
        T_cam_submap = np.linalg.inv(submap.T_submap_kf[view.index])
        ids = submap.landmark_of[view.index]
        return Track(view, T_cam_submap, T_cam_submap, ids, n, n, n, 1.0, False, np.zeros((6, 6)))

    def _walk_back(self, submap: Submap, graph: SubmapGraph, newest: View) -> None:
        """Run the front end in the other direction of time, from the newest view to the last frame that has a pose."""
        walker = self._parts.new_odometry(submap, graph)
        walker.start_at(newest.index)
        n_failed = 0
        for view in self._buffer.backwards_from(newest.index):
            posed = self.poses.get(view.index)
            if posed is not None and posed.submap_id != submap.id:
                break
            track = self._track_with(walker, view)
            if not track:
                n_failed += 1
                if n_failed > self._config.tracking.max_lost_frames:
                    break
                continue
            n_failed = 0

    # --- tracking

    def _track(self, live: VisualOdometry, view: View) -> Track | Failure:
        track = self._track_with(live, view)
        if track:
            self._lost = []
            if live.reference_id == view.index and self._parts.calibration.is_due(live.submap):
                self._calibrate(live, view)
            if len(live.submap.keyframes) >= self._config.graph.max_keyframes:
                self._roll_over(live, view)
            return track
        assert isinstance(track, Failure)
        self._lost.append(view)
        self.rows[view.index].status = FrameStatus.LOST
        if len(self._lost) == 1:
            self._buffer.freeze()
        if len(self._lost) > self._config.tracking.max_lost_frames:
            self._give_up(live, view, track)
        return track

    def _track_with(self, odometry: VisualOdometry, view: View) -> Track | Failure:
        """Pose a frame, judge it, record it, and make it a keyframe where one is due."""
        with self.timer.measure("tracking"):
            track = judge_track(odometry.track(view), self._config.health)
        if isinstance(track, Failure):
            return track
        if track.wide:
            self._event(EventKind.RELOCALISED, view, odometry.submap.id, n_inliers=track.n_inliers)
        if odometry.keyframe_due(track):
            with self.timer.measure("mapping"):
                report = odometry.insert_keyframe(track)
            self.timer.add("graph (in mapping)", report.estimate.seconds)
            if report.estimate.rebuilt:
                self._event(EventKind.GRAPH_REBUILT, view, odometry.submap.id)
        reference = odometry.reference_id
        self._pose(
            FramePose(view.index, view.timestamp_s, odometry.submap.id, reference, odometry.relative_pose(track)), track
        )
        return track

    def _calibrate(self, live: VisualOdometry, view: View) -> None:
        """Ask the submap about its camera. Where the answer is clear, submap, graph and buffer change to it."""
        calibration = self._parts.calibration
        with self.timer.measure("calibration"):
            refined = calibration.refine(live.submap, self._parts.new_graph())
            if isinstance(refined, Failure):
                self._event(EventKind.CALIBRATION_KEPT, view, live.submap.id, reason=refined.detail, **refined.numbers)
                return
            live.adopt(refined.graph)
            self._buffer.map(calibration.rectified)
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
        self._live = None
        self._starter = self._parts.new_starter()
        for lost in self._lost:
            self._starter.collect(lost)
        self._lost = []

    def _archive(self, live: VisualOdometry, why: str) -> None:
        submap = live.submap
        last = max(self.poses[i].index for i in self.poses if self.poses[i].submap_id == submap.id)
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
        graph.rebuild(submap)
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
