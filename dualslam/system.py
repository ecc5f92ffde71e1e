"""The state machine of Dual-SLAM: one frame at a time, in the order in which the paper tells it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from dualslam.calibration.background import Calibrations
from dualslam.calibration.lens import Calibration
from dualslam.calibration.shutter_watch import MAX_GAP_S, ShutterWatch
from dualslam.config.settings import Config
from dualslam.core.atlas_problem import AtlasSolver
from dualslam.core.bundle import BundleAdjuster
from dualslam.core.camera.base import Camera
from dualslam.core.errors import SolverError
from dualslam.core.events import EventKind
from dualslam.core.geometry import se3, so3
from dualslam.core.interfaces import START_REACH, MapStarter, Seeker, Shutter, SubmapGraph, VisualOdometry
from dualslam.core.types import Failure, FailureReason, FloatArray, Frame, FrameStatus, Start, Track, View
from dualslam.health import HealthMonitor, count_signs
from dualslam.io.map_store import StoredMap
from dualslam.map.atlas import Link
from dualslam.map.connections import Connections
from dualslam.map.endings import archive, hand_frames_over
from dualslam.map.frame_numbers import FrameNumbers
from dualslam.map.frame_records import FrameResult, FrameRow
from dualslam.map.graph_beside import N_FREE, N_FREE_BEHIND, BesideGraphs, Moved
from dualslam.map.propagation import propagate_links
from dualslam.map.record import FrameStamp, Record
from dualslam.map.split import next_submap, submap_of, take_out
from dualslam.map.submap import Submap
from dualslam.map.trajectory import FramePose
from dualslam.map.worlds import Worlds
from dualslam.pace import Pace
from dualslam.places.handover import Handover
from dualslam.places.revisits import Revisits
from dualslam.places.sightings import PlaceParts, Relocalised
from dualslam.recovery.bypass import drop_corrupted
from dualslam.recovery.executor import RecoveryExecutor
from dualslam.recovery.frame_buffer import FrameBuffer
from dualslam.recovery.leaps import LeapWatch
from dualslam.recovery.manager import Recoveries
from dualslam.recovery.relocaliser import Relocaliser
from dualslam.recovery.scale_watch import ScaleLoss, ScaleWatch
from dualslam.recovery.walk_news import WalkNews, WalkWatch
from dualslam.workers.jobs import Desk, JobKind

log = logging.getLogger(__name__)

SETTLED_A_FRAME = 20
"""Buffered views that follow a change of the camera at each frame: 2 to 4 ms, where all of 10 s would take 30 to 60."""
TAKEN_IN_A_FRAME = 1000
"""Landmarks that the index of places takes in at each frame in real time: 2 to 3 ms, where all that came during reverse
tracking take 20."""

ROOM_TO_COME_BACK = 1.2
"""A full submap of an earlier run takes so many times `graph.max_keyframes`: what later visits add to a place that is
mapped (the first one about a tenth, hardly any the next) is no reason to map it once more."""


@dataclass(frozen=True, slots=True)
class Components:
    """The parts that the composition root puts in: the system itself knows neither front end nor solver.

    `new_relocaliser`: a front end that finds its submap again wherever it is seen, and tracks from there.
    `walk_watch`: hears of walks back that are under way. `desk`: does the work beside the tracking; reverse tracking
    has an executor of its own, which may use the same desk. `graphs`: carries changes to submaps' graphs in another
    process and back, if they are solved there. `open_features`: starts one more process, and returns a function that
    has the features of a frame found there.
    """

    view_of: Callable[[Frame], View | Failure]
    new_starter: Callable[[], MapStarter]
    new_graph: Callable[[], SubmapGraph]
    new_odometry: Callable[[Submap, SubmapGraph], VisualOdometry]
    new_relocaliser: Callable[[Submap, SubmapGraph], Seeker]
    calibration: Calibration
    shutter: Shutter
    recovery: RecoveryExecutor
    walk_watch: WalkWatch
    atlas_solver: AtlasSolver
    adjust_bundle: BundleAdjuster
    places: PlaceParts
    desk: Desk
    graphs: BesideGraphs | None = None
    open_features: Callable[[], Callable[[Frame], Frame]] | None = None

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
    pace : Pace
        Whoever feeds the system in real time reports here how late its frames are; otherwise without effect.
    on_pose : callable or None
        Called with each frame's track as soon as it is posed, before the map grows from it, so that a controller need
        not wait for a keyframe.
    numbers : FrameNumbers
        The frames' own count, by which all here goes but the frames that `step` is given and its results.
    saved : StoredMap or None
        The map that this run continues.
    """

    def __init__(
        self, components: Components, config: Config, saved: StoredMap | None = None, localise: bool = False
    ) -> None:
        """`saved`: a map to continue, which becomes this system's own; `localise`: only find poses in it."""
        record = Record() if saved is None else Record(saved.atlas, poses=dict(saved.poses))
        self.saved, self.numbers = saved, FrameNumbers(0 if saved is None else saved.next_id)
        self._world = saved.main[0] if saved is not None and saved.main else None
        self._localises = localise
        self._earlier = frozenset(record.atlas.submaps)
        self._worlds = Worlds(record.atlas, self._world)
        self._n_without_map = 0
        self.atlas, self.rows, self.poses = record.atlas, record.rows, record.poses
        self.events, self.timer = record.events, record.timer
        self._record = record
        self._parts = components
        self._config = config
        self.buffer = FrameBuffer(config.buffer.duration_s, config.buffer.max_mb)
        self.buffer.freeze()  # no map yet, as after a loss: the first start is walked back from to the first frame
        self._live: VisualOdometry | None = None
        self._relocaliser = Relocaliser(components.new_relocaliser, config)
        self._starter = components.new_starter()
        self._lost: list[View] = []
        self._to_revisit = False
        self._health = HealthMonitor(config.health)
        self._leaps = LeapWatch()
        self._scale_watch = ScaleWatch(config.linking, components.desk) if config.audit.enabled else None
        self._connections = Connections(
            record,
            components.atlas_solver,
            components.new_graph,
            components.adjust_bundle,
            components.desk,
            self._front_ends,
        )
        self._weak_landmarks = config.keyframes.weak_landmarks
        self.pace = Pace()
        self.on_pose: Callable[[Track], None] | None = None
        self._last_pose: FramePose | None = None
        self._posed_at: float | None = None  # on the clock of `time.perf_counter`
        self._revisits = Revisits(
            record,
            components.places,
            self._connections,
            components.desk,
            components.new_graph,
            components.new_relocaliser,
            config,
            merges=config.recovery.enabled or saved is not None,
        )
        extends = saved is not None and not localise and config.places.enabled and config.loops.enabled
        self._handover = Handover(record, self._revisits.sightings, self._earlier) if extends else None
        self._recoveries = Recoveries(
            record,
            self.buffer,
            components.recovery,
            components.new_graph,
            components.calibration,
            self._connections,
            config.recovery,
            config.audit.enabled,
        )
        self._calibrations = Calibrations(
            record, self.buffer, components.calibration, components.desk, components.new_graph, self._connections
        )
        self._shutter_watch = ShutterWatch(
            record,
            self.buffer,
            components.calibration,
            components.shutter,
            components.desk,
            components.new_graph,
            self._connections,
        )

    @property
    def desk(self) -> Desk:
        """Where work beside the tracking is done."""
        return self._parts.desk

    @property
    def camera(self) -> Camera:
        """By which features are rectified now."""
        return self._parts.calibration.camera

    @property
    def log_focal_sigma(self) -> float | None:
        """Standard deviation of the logarithm of that camera's focal length; None where it is as it was given."""
        return self._parts.calibration.log_focal_sigma

    @property
    def world(self) -> int | None:
        """The submap in whose frame the saved map's world is; None without one."""
        return self._world

    @property
    def live(self) -> VisualOdometry | None:
        """The front end of the live submap; None while there is no map."""
        return self._live

    def features_beside(self) -> Callable[[Frame], Frame] | None:
        """Start a process that finds the features of the frame to come while another is tracked.

        Returns
        -------
        callable or None
            Waits for a frame's features, on a thread of the caller's, and returns the frame with them, to be given to
            `step`. None where all is done in one process.
        """
        return None if self._parts.open_features is None else self._parts.open_features()

    def is_walking_back(self, submap_id: int) -> bool:
        """Whether a walk back in time from a submap is under way."""
        return self._recoveries.is_under_way(self.atlas.submaps[submap_id])

    def watch_walks(self, on_walk: Callable[[WalkNews], None]) -> None:
        """Have a function called with how far walks back have come, while they are under way; some news may be lost.

        It may look at the system, and change nothing. Frames are told by their index in the source.
        """
        numbers = self.numbers
        self._parts.walk_watch.add(lambda news: on_walk(replace(news, frame=numbers.index_of(news.frame))))

    def _front_ends(self) -> list[VisualOdometry]:
        """Return the front ends that track in a submap, or may soon: they must follow when it moves."""
        return [front_end for front_end in (self._live, self._relocaliser.relocaliser) if front_end is not None]

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
        started, self._posed_at = time.perf_counter(), None
        source, frame = frame, replace(frame, index=self.numbers.number(frame.index))
        self.rows[frame.index] = FrameRow(frame.index, frame.timestamp_s, FrameStatus.INITIALISING)
        # 1. What was found beside the tracking meanwhile comes into the map between two frames.
        self._collect_graphs(frame)
        self._collect_places(frame)
        self._calibrations.collect(self._live, frame, self._recoveries.waiting)
        self._recoveries.collect(self._live, frame)
        self.buffer.settle(SETTLED_A_FRAME)
        # 2. Features, into the buffer that a walk back in time will read.
        with self.timer.measure("features"):
            view = self._parts.view_of(source)
        if isinstance(view, Failure):
            outcome: Track | Failure = self._unusable(frame, view)
        else:
            view = replace(view, index=frame.index)
            self.buffer.append(view)
            # 3. Without a live submap, look for the lost one, or try to start one; with one, track.
            outcome = self._initialise(view) if self._live is None else self._track(self._live, view)
        return self._result(frame, outcome, started)

    def finish(self, interrupted: bool = False) -> None:
        """End the run: wait, for a limited time, for reverse tracking that is under way; archive the live submap.

        Parameters
        ----------
        interrupted : bool
            Someone is waiting: leave out the last reverse tracking, which the growth of the live map would earn.
        """
        last = next(reversed(self.rows.values()), None)
        if self._parts.graphs is not None and last is not None:
            self._follow_graphs(self._parts.graphs.finish(self.atlas.submaps), last)
        self._recoveries.finish(self._live, last, interrupted or self._localises)
        if last is not None and self._revisits.finish(self._live, last) is not None and self._live is not None:
            self._recoveries.settle(self._live)
        if self._parts.graphs is not None and last is not None:
            self._follow_graphs(self._parts.graphs.finish(self.atlas.submaps), last)
        if self._live is not None and not self._localises:
            self._archive(self._live, "end of sequence")
        if last is not None:
            self._connections.settle(last)
        self._parts.desk.close()

    # --- initialising

    def _initialise(self, view: View) -> Track | Failure:
        if self._relocaliser.note(view) and (track := self._relocalise(view)):
            return track
        if track := self._relocalise_anywhere(view):
            return track
        if self._localises:
            return Failure(FailureReason.TOO_FEW_MATCHES, "the saved map does not show this place")
        shutter = self._parts.shutter
        with self.timer.measure("shutter"):
            readout_s = shutter.readout_s
            may_start = shutter.may_start(view, self._parts.calibration.camera)
            if shutter.readout_s != readout_s:
                view = self._correct_shutter(view)
        if not may_start:
            return Failure(FailureReason.DOUBTFUL_INITIALISATION, "a fast turn before the shutter is known")
        with self.timer.measure("initialisation"):
            start = self._starter.add(view, briefly=self.pace.in_real_time)
        if isinstance(start, Failure):
            if start.reason is FailureReason.DOUBTFUL_INITIALISATION:
                self._record.event(EventKind.INITIALISATION_REFUSED, view, None, reason=start.detail, **start.numbers)
            return start
        outcome = self._begin_submap(start, start.views[-1])
        # A search beside the tracking finds a start that ends some frames back: go on from there.
        for later in [v for v in self.buffer if start.views[-1].index < v.index <= view.index]:
            if self._live is None:
                break
            outcome = self._track(self._live, later)
        return outcome

    def _relocalise(self, view: View) -> Track | None:
        """Continue in the map that was lost last, once two frames in a row show it."""
        with self.timer.measure("relocalisation"):
            relocaliser = self._relocaliser.sighted(view)
        if relocaliser is None:
            return None
        track = self._track_with(relocaliser, view)
        if isinstance(track, Failure):
            if track.reason is FailureReason.SOLVER:
                self._relocaliser.end()
            return None
        self._live = relocaliser
        self._relocaliser.end()
        self._record.event(EventKind.RELOCALISED, view, relocaliser.submap.id, n_inliers=track.n_inliers)
        self._leaps.begin(view)
        self._recoveries.found_again(relocaliser.submap)
        self.buffer.thaw()
        return track

    def _relocalise_anywhere(self, view: View) -> Track | None:
        """Continue in any submap that a few frames in a row show: at once in a saved map, else where no map starts."""
        self._n_without_map += len(view.features) >= self._config.tracking.min_inliers
        recovery = self._config.recovery
        after = 0 if self.saved is not None else recovery.relocalise_after if recovery.enabled else None
        if not self.atlas.submaps or after is None or self._n_without_map <= after:
            return None
        with self.timer.measure("places"):
            found = self._revisits.sightings.sighted(view, self._parts.K)
        if found is None:
            return None
        self._live, submap = found.odometry, found.odometry.submap
        self._relocaliser.end()
        self._n_without_map = 0
        self._health = HealthMonitor(self._config.health)
        for track, T_kf_cam in (*found.earlier, (found.track, self._live.relative_pose(found.track))):
            at = track.view
            pose = FramePose(at.index, at.timestamp_s, submap.id, found.reference, T_kf_cam)
            self._record.pose(pose, track.n_matches, track.n_inliers)
        first = found.earlier[0][0]
        self._record.event(
            EventKind.RELOCALISED,
            view,
            submap.id,
            n_inliers=first.n_inliers,
            other_frame=found.reference,
            frames=len(found.earlier) + 1,
        )
        if not self._localises:
            self._leaps.begin(found.earlier[0][0].view)
            self._recoveries.found_again(submap)
            self.buffer.thaw()
        return found.track

    def _correct_shutter(self, view: View) -> View:
        """Take the shutter that was found out of the frames so far; the starter begins anew. Returns the view's own."""
        shutter, camera = self._parts.shutter, self._parts.calibration.camera
        self._record.event(EventKind.SHUTTER_FOUND, view, None, readout_s=shutter.readout_s)
        correction = shutter.correction(self.buffer.indices, camera)
        if correction is None:
            self.buffer.change_all(lambda views: shutter.all_corrected(views, camera))
        else:
            self.buffer.map_later(correction, "shutter")
        self._starter = self._parts.new_starter()
        self._relocaliser.end()  # it is of the pixels of before
        *waiting, newest = self.buffer.newest(START_REACH + 1)
        for earlier in waiting:
            if self.rows[earlier.index].submap is None:
                self._starter.collect(earlier)
        return newest

    def _begin_submap(self, start: Start, view: View) -> Track | Failure:
        """Make a submap of a start, and pose the frames before and between by reverse tracking over the buffer."""
        submap = Submap.from_start(start, len(self.atlas.submaps), self._parts.K)
        graph = self._parts.new_graph()
        try:
            with self.timer.measure("graph"):
                estimate = graph.update(submap)
        except SolverError as error:
            return Failure(FailureReason.SOLVER, str(error), start.numbers)
        submap.apply_estimate(*estimate.values)
        kind = EventKind.INITIALISED if not self.atlas.submaps else EventKind.REINITIALISED
        self.atlas.add(submap)
        for k, keyframe in submap.keyframes.items():
            self._record.pose(FramePose(k, keyframe.timestamp_s, submap.id, k, np.eye(4)))
            row = self.rows[k]
            row.n_matches = row.n_inliers = int((submap.landmark_of[k] >= 0).sum())
        self._record.event(kind, view, submap.id, first_view=start.views[0].index, **start.numbers)
        self._live = self._parts.new_odometry(submap, graph)
        self._relocaliser.end()
        self._live.start_at(view.index)
        self._n_without_map = 0
        self._health = HealthMonitor(self._config.health)
        self._recoveries.start(submap, view)
        self._recoveries.collect(self._live, view)
        self.buffer.thaw()
        n = int((submap.landmark_of[view.index] >= 0).sum())
        T_cam_submap = se3.inverse(submap.T_submap_kf[view.index])
        ids = submap.landmark_of[view.index]
        return Track(view, T_cam_submap, T_cam_submap, ids, np.zeros(0, np.int64), n, n, 1.0, False, np.zeros((6, 6)))

    # --- tracking

    def _track(self, live: VisualOdometry, view: View) -> Track | Failure:
        track = self._track_with(live, view)
        if track and self._localises:
            return track
        if track:
            self._lost = []
            self.buffer.thaw()
            first = self._leaps.first_beyond
            wide = isinstance(track, Track) and track.wide
            contradicted = self._leaps.judge(view, wide, self._record, live.submap)
            if contradicted is not None and first is not None:
                self._break_at(live, view, first.index, contradicted)
                return contradicted
            if isinstance(track, Track) and (found := self._seen_from(live, track)) is not None:
                return self._go_over(live, found, view)
            if live.reference_id != view.index:
                if self.pace.in_real_time and not self.pace.behind:
                    self._catch_up_on_places(live, view)
                return track
            if (loss := self._scale_lost(live.submap)) is not None and self._part_at(live, view, loss):
                return track
            self._ask_shutter(live, view)
            self._calibrations.ask_if_due(live, view, self._recoveries.waiting)
            if len(live.submap.keyframes) >= self._max_keyframes(live.submap):
                self._roll_over(live, view)
            else:
                self._recoveries.retry(live.submap, view)
                self._recoveries.audit_if_due(live.submap, view)
                if self.pace.in_real_time and not self._to_revisit:
                    self._to_revisit = True  # a keyframe's frame has enough to do: with the next that comes in time
                else:
                    self._revisit(live, view)
            return track
        assert isinstance(track, Failure)
        if self._localises:
            self._live = None
            self.rows[view.index].status = FrameStatus.LOST
            return track
        self._lost.append(view)
        self.rows[view.index].status = FrameStatus.LOST
        if len(self._lost) == 1:
            self.buffer.freeze()
        if len(self._lost) > self._config.tracking.max_lost_frames or track.reason is FailureReason.SOLVER:
            self._give_up(live, view, track)
        return track

    def _catch_up_on_places(self, live: VisualOdometry, view: View) -> None:
        """Do a part of what is left to do for places: first take in what the map has gained, then look for them."""
        with self.timer.measure("places"):
            n_taken = self._revisits.take_in(live.submap, TAKEN_IN_A_FRAME)
        if self._to_revisit and not n_taken:
            self._revisit(live, view)

    def _with_turn_of_poses(self, submap: Submap, track: Track) -> Track:
        """Return a frame that is to become a keyframe with the turn taken out of its pixels that its pose tells.

        Matches to the frame before tell it before there is a pose, and take a part of what the camera has moved for a
        turn.
        """
        view, before = track.view, self._last_pose
        if view.turn_rad is None or before is None or before.submap_id != submap.id:
            return track
        gap_s = view.timestamp_s - before.timestamp_s
        if not 0 < abs(gap_s) <= MAX_GAP_S:
            return track
        R_before = submap.resolve_anchor(before.keyframe_id, before.T_kf_cam)[:3, :3]
        rate_rad_s = so3.log(R_before.T @ track.T_cam_submap[:3, :3].T) / gap_s
        shutter, camera = self._parts.shutter, self._parts.calibration.camera
        turn_rad = shutter.readout_s * rate_rad_s
        features = shutter.moved(view.features, camera, turn_rad - view.turn_rad)
        return replace(track, view=replace(view, features=features, turn_rad=turn_rad))

    def _ask_shutter(self, live: VisualOdometry, view: View) -> None:
        """Ask the live map how long its images were read; not where what comes back meanwhile has the pixels of now."""
        under_way = self._recoveries.is_under_way(live.submap) or self._parts.desk.n_open(JobKind.CALIBRATION)
        if self.saved is None and not under_way:
            self._shutter_watch.ask_if_due(live, view, self._recoveries.waiting)

    def _revisit(self, live: VisualOdometry, view: View) -> None:
        """Link the live map where its newest keyframe shows a place again; not while reverse tracking is under way."""
        self._to_revisit = False
        if self._recoveries.is_under_way(live.submap):
            return
        with self.timer.measure("places"):
            self._revisits.note_keyframe(live, TAKEN_IN_A_FRAME if self.pace.in_real_time else None)
        self._collect_places(view)

    def _collect_places(self, now: FrameStamp) -> None:
        """Link the places that were found; while reverse tracking is under way, they wait for its end."""
        live = self._live
        if live is not None and self._recoveries.is_under_way(live.submap):
            return
        with self.timer.measure("places"):
            report = self._revisits.collect(live, now)
        if report is not None and live is not None:
            self._recoveries.settle(live)

    def _track_with(self, odometry: VisualOdometry, view: View) -> Track | Failure:
        """Pose a frame, judge it, record it, and make it a keyframe where one is due."""
        with self.timer.measure("tracking"):
            track = self._health.judge(odometry.track(view), view.index)
        if isinstance(track, Failure):
            return track
        self._posed_at = time.perf_counter()
        if self.on_pose is not None:
            self.on_pose(track)
        if not self._localises:
            odometry.submap.count_sightings(track)
        if track.wide:
            self._record.event(EventKind.GAP_RELOCALISED, view, odometry.submap.id, n_inliers=track.n_inliers)
        if self._localises:
            cast(Seeker, odometry).look_about()
        elif self._keyframe_due(odometry, track):
            track = self._with_turn_of_poses(odometry.submap, track)
            try:
                with self.timer.measure("mapping"):
                    report = odometry.insert_keyframe(track)
            except SolverError as error:
                return Failure(FailureReason.SOLVER, str(error))
            self._health.note_keyframe(report)
            if isinstance(report, Failure):
                return report
            self.timer.add("graph (in mapping)", report.graph_seconds)
            if report.rebuilt:
                self._record.event(EventKind.GRAPH_REBUILT, view, odometry.submap.id)
        pose = FramePose(
            view.index, view.timestamp_s, odometry.submap.id, odometry.reference_id, odometry.relative_pose(track)
        )
        self._record.pose(pose, track.n_matches, track.n_inliers)
        self._last_pose = pose
        return track

    def _keyframe_due(self, odometry: VisualOdometry, track: Track) -> bool:
        """Whether a frame is to become a keyframe, now and in this submap."""
        if not odometry.keyframe_due(track):
            odometry.go_by_known(track)
            return False
        if self.pace.puts_off(track.n_inliers, self._weak_landmarks):
            return False
        if self._handover is None or odometry is not self._live or self._recoveries.is_under_way(odometry.submap):
            return True
        with self.timer.measure("places"):
            return not self._handover.waits(track, odometry, self._parts.K, self.pace.in_real_time)

    # --- graphs beside the tracking

    def _collect_graphs(self, now: FrameStamp) -> None:
        """Move submaps to what their graphs have solved meanwhile, and send the graphs what is new."""
        graphs = self._parts.graphs
        if graphs is None:
            return
        graphs.n_free = N_FREE_BEHIND if self.pace.behind else N_FREE
        with self.timer.measure("graph (late)"):
            if self._live is not None and not self.pace.may_lag(graphs.lag(self._live.submap)):
                self._follow_graphs(graphs.wait(self.atlas.submaps), now)
            self._follow_graphs(graphs.collect(self.atlas.submaps), now)

    def _follow_graphs(self, moved: Iterable[Moved], now: FrameStamp) -> None:
        for each in moved:
            propagate_links(self.atlas, each.before, each.submap)
            if self._live is not None and self._live.submap is each.submap:
                self._live.adopt(self._live.graph, each.before)
            if each.rebuilt:
                self._record.event(EventKind.GRAPH_REBUILT, now, each.submap.id)

    # --- failure

    def _give_up(self, live: VisualOdometry, view: View, failure: Failure) -> None:
        """Declare the track failed: archive the submap whole, and start the next from the frames since the loss."""
        suspected = self._health.suspected()
        onset = min([self._lost[0].index, *(frame.index for frame in suspected)])
        self._record.event(
            EventKind.FAILED,
            view,
            live.submap.id,
            reason=str(failure.reason),
            detail=failure.detail,
            lost_since=self._lost[0].index,
            suspected_since=onset,
            signs=count_signs(frame for frame in suspected if not frame.failed),
            **failure.numbers,
        )
        self._archive(live, "track lost")
        self._leaps.end()
        self._recoveries.declare_lost(live.submap.id, onset, str(failure.reason), self._lost[0].index)
        self._live = None
        self._health = HealthMonitor(self._config.health)
        # Not where its graph has failed, where two poses stood, or where a walk back is about to change it.
        doubtful = failure.reason in (FailureReason.LOOK_ALIKE, FailureReason.LEAP)
        if doubtful:
            self._revisits.sightings.avoid(live.submap.id)
        hopeless = doubtful or failure.reason is FailureReason.SOLVER
        if not hopeless and not self._recoveries.is_under_way(live.submap):
            self._relocaliser.begin(live)
        self._starter = self._parts.new_starter()
        for lost in self._lost:
            self._starter.collect(lost)
        self._lost = []

    def _break_at(self, live: VisualOdometry, view: View, first: int, failure: Failure) -> None:
        """End a map that is broken since frame `first`; reverse tracking will pose the frames since then."""
        self._lost = [buffered for buffered in self.buffer if buffered.index >= first] or [view]
        self.buffer.freeze()
        drop_corrupted(self._record, live.submap.id, first)
        live.submap.condemn({k for k in live.submap.keyframes if k >= first})
        self._give_up(live, view, failure)

    def _scale_lost(self, submap: Submap) -> ScaleLoss | None:
        """Return where a live map has lost its scale; not while a walk back is about to change it."""
        if self._scale_watch is None or self._recoveries.is_under_way(submap):
            return None
        with self.timer.measure("audit"):
            return self._scale_watch.judge(submap, self.atlas.believed)

    def _part_at(self, live: VisualOdometry, view: View, loss: ScaleLoss) -> bool:
        """End a map where it has lost its scale, and continue in a new one from there; return whether it was done.

        Reverse tracking from the new one may link the two.
        """
        old, graph = live.submap, self._parts.new_graph()
        rest = [k for k in old.keyframes if k >= loss.first]
        submap = submap_of(old, len(self.atlas.submaps), rest)
        try:
            graph.rebuild(submap)
        except SolverError as error:
            log.warning("submap %d is not parted where it has lost its scale: %s", old.id, error)
            return False
        self._record.event(
            EventKind.FAILED,
            view,
            old.id,
            reason=str(FailureReason.SCALE_LOST),
            detail=loss.detail,
            lost_since=loss.first,
            suspected_since=loss.since,
            sigma_scale=loss.sigma,
        )
        self._archive(live, "scale lost")
        hand_frames_over(self._record, old, submap)
        take_out(old, rest, max(old.keyframes.keys() - submap.keyframes.keys()))
        self.atlas.add(submap)
        n = int(submap.landmarks["alive"].sum())
        self._record.event(EventKind.REINITIALISED, view, submap.id, first_view=loss.first, n_points=float(n))
        self._live = self._parts.new_odometry(submap, graph)
        self._live.start_at(view.index)
        self._leaps.end()
        self._recoveries.declare_lost(old.id, loss.since, str(FailureReason.SCALE_LOST), loss.first)
        first = next((buffered for buffered in self.buffer if buffered.index == loss.first), None)
        if first is not None:
            self._recoveries.start(submap, first)
            self._recoveries.collect(self._live, view)
        return True

    def _archive(self, live: VisualOdometry, why: str) -> None:
        archive(self._record, live.submap, live.graph, why)

    def _unusable(self, frame: Frame, failure: Failure) -> Failure:
        """Record a frame without an image of the right size; tracking continues with the next frame."""
        self.rows[frame.index].status = FrameStatus.UNREADABLE
        self.events.add(EventKind.UNREADABLE, frame.index, frame.timestamp_s, None, detail=failure.detail)
        return failure

    # --- a submap that is full

    def _max_keyframes(self, submap: Submap) -> int:
        """Return with how many keyframes a submap is full; one that was full when an earlier run left it has room."""
        share = ROOM_TO_COME_BACK if submap.id in self._earlier else 1.0
        return int(share * self._config.graph.max_keyframes)

    def _roll_over(self, live: VisualOdometry, view: View) -> None:
        """Continue in a new submap that shares its first keyframes with the full one: no failure, and a stiff link."""
        submap = next_submap(live.submap, len(self.atlas.submaps), self._config.graph.rollover_keyframes, view.index)
        graph = self._parts.new_graph()
        try:
            graph.rebuild(submap)
        except SolverError as error:
            log.warning("submap %d stays open beyond its cap: %s", live.submap.id, error)
            return
        self.atlas.add(submap)
        self._record.event(EventKind.ROLLED_OVER, view, submap.id, from_submap=live.submap.id)
        self._archive(live, "full")
        link = Link.of_rollover(live.submap, submap)
        self._live = self._parts.new_odometry(submap, graph)
        self._live.start_at(list(submap.keyframes)[-1])
        self._connections.connect([link], view)

    def _seen_from(self, live: VisualOdometry, track: Track) -> Relocalised | None:
        """Return the submap of an earlier run that shows what the live one has come to, once that is sure."""
        if self._handover is None:
            return None
        with self.timer.measure("places"):
            return self._handover.follow(track, live)

    def _go_over(self, live: VisualOdometry, found: Relocalised, view: View) -> Track:
        """Go on in the submap of an earlier run that has this place already."""
        self._archive(live, "an earlier map goes on")
        self._live, submap, track = found.odometry, found.odometry.submap, found.track
        reference = self._live.reference_id
        pose = FramePose(view.index, view.timestamp_s, submap.id, reference, self._live.relative_pose(track))
        self._record.pose(pose, track.n_matches, track.n_inliers)
        self._record.event(
            EventKind.RELOCALISED,
            view,
            submap.id,
            n_inliers=track.n_inliers,
            other_frame=reference,
            frames=len(found.earlier) + 1,
            from_submap=live.submap.id,
        )
        self._health = HealthMonitor(self._config.health)
        return track

    # --- records

    def _result(self, frame: Frame, outcome: Track | Failure, started: float) -> FrameResult:
        row = self.rows[frame.index]
        row.latency_ms = 1e3 * (time.perf_counter() - started)
        pose_ms = None if self._posed_at is None else 1e3 * (self._posed_at - started)
        pose = self.poses.get(frame.index)
        T_submap_cam = None
        if pose is not None:
            T_submap_cam = self.atlas.submaps[pose.submap_id].resolve_anchor(pose.keyframe_id, pose.T_kf_cam)
        failure = outcome if isinstance(outcome, Failure) else None
        S_world_submap, world_id = (None, None) if pose is None else self._worlds.of(pose.submap_id)
        return FrameResult(
            self.numbers.index_of(frame.index),
            row.status,
            row.submap,
            T_submap_cam,
            row.n_matches,
            row.n_inliers,
            row.latency_ms,
            failure,
            pose_ms,
            S_world_submap,
            world_id,
        )
