"""The state machine of Dual-SLAM: one frame at a time, in the order in which the paper tells it."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial

from dualslam.atlas.connections import Connections
from dualslam.atlas.record import FrameStamp, Record
from dualslam.atlas.stored_map import StoredMap
from dualslam.atlas.trajectory import Worlds
from dualslam.core.camera.base import Camera
from dualslam.core.config.settings import Config
from dualslam.core.events import EventKind
from dualslam.core.interfaces import SubmapGraph, VisualOdometry
from dualslam.core.jobs import JobKind
from dualslam.core.noise_model import GROUP, START_POINTS
from dualslam.core.types import BoolArray, Failure, FailureReason, Features, Frame, FrameStatus, Start, Track, View
from dualslam.core.walk_news import WalkNews
from dualslam.map.frame_numbers import FrameNumbers
from dualslam.map.frame_records import FrameResult, FrameRow
from dualslam.map.submap import Submap
from dualslam.places.handover import Handover
from dualslam.places.revisits import Revisits
from dualslam.places.sightings import Relocalised
from dualslam.recovery.frame_buffer import SLOW_HZ, FrameBuffer
from dualslam.recovery.fusion import link_overlaps
from dualslam.recovery.manager import Recoveries
from dualslam.system.audit.photometric import PhotometricAudit
from dualslam.system.audit.verdict import ReasonCode
from dualslam.system.camera.background import Calibrations
from dualslam.system.camera.shutter_watch import ShutterWatch
from dualslam.system.endings import Endings
from dualslam.system.graphs import GraphKeeping
from dualslam.system.health import HealthMonitor
from dualslam.system.masking import Masking
from dualslam.system.motion_watch import Break
from dualslam.system.places import PlaceKeeping
from dualslam.system.pose_covariance import PoseCovariance
from dualslam.system.registering import Registering
from dualslam.system.starting import Starting
from dualslam.system.state import Components, State
from dualslam.system.tracking import Tracking
from dualslam.workers.scheduled_desk import ScheduledDesk

SETTLED_A_FRAME = 10
"""Buffered views that follow a change of the camera at each frame: 3 to 4 ms, where all of 10 s would take 100."""


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
        Lag reported by the real-time feeder; unused otherwise.
    blank : set of int
        Frames without a pose that nothing could pose: `_note_blank`.
    audit : PhotometricAudit
        How well the images agree with the map.
    numbers : FrameNumbers
        The frames' own count, by which all here goes but the frames that `step` is given and its results.
    saved : StoredMap or None
        The map that this run continues.
    world : int or None
        The submap in whose frame that map's world is.
    """

    def __init__(
        self, components: Components, config: Config, saved: StoredMap | None = None, localise: bool = False
    ) -> None:
        """`saved`: a map to continue, which becomes this system's own; `localise`: only find poses in it."""
        record = Record() if saved is None else Record(saved.atlas, poses=dict(saved.poses))
        self.saved, self.numbers = saved, FrameNumbers(0 if saved is None else saved.next_id)
        self.blank: set[int] = set()
        self._before: View | None = None  # the frame before, of those that were read
        self._apart = set[int]()  # it and the lost frames before it from which nothing leads to a pose
        self.world = saved.main[0] if saved is not None and saved.main else None
        self._worlds = Worlds(record.atlas, self.world)
        self._earlier = earlier = frozenset(record.atlas.submaps)
        self.atlas, self.rows, self.poses = record.atlas, record.rows, record.poses
        self.events, self.timer = record.events, record.timer
        self.buffer = FrameBuffer(config.buffer.duration_s, config.buffer.max_mb)
        self.buffer.freeze()  # no map yet, as after a loss: the first start is tracked back from to the first frame
        health = HealthMonitor(config.health)
        self.audit = PhotometricAudit(components.patches)
        self._state = State(components, config, record, self.buffer, saved, localise, health, self.audit)
        self.pace = self._state.pace
        # Background results that come into the map between two frames.
        self._connections = Connections(
            record,
            components.atlas_solver,
            components.new_graph,
            components.desk,
            self._state.front_ends,
            None if components.graphs is None else components.graphs.forget,
        )
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
        self._recoveries = Recoveries(
            record,
            self.buffer,
            components.desk,
            components.new_graph,
            components.calibration,
            self._connections,
            config.recovery,
            self._state.front_ends,
        )
        self._calibrations = Calibrations(self._state, self._recoveries, self._connections)
        self._shutter_watch = ShutterWatch(self._state, self._recoveries, self._connections)
        # The steps of a frame.
        sightings = self._revisits.sightings
        extends = saved is not None and not localise and config.places.enabled and config.loops.enabled
        handover = Handover(record, sightings, earlier) if extends else None
        self._graphs = GraphKeeping(self._state)
        self._places = PlaceKeeping(self._state, self._revisits, self._recoveries, handover)
        self._tracking = Tracking(self._state, self._places)
        self._starting = Starting(self._state, self._tracking, self._recoveries, sightings)
        self._masking = Masking(self._state, self._starting)
        self._registering = Registering(self._state, self._connections)
        self._endings = Endings(self._state, self._recoveries, self._connections, sightings, earlier)

    @property
    def _registers(self) -> bool:
        """Whether frames outside the main map are registered at the end of the run."""
        return self._state.config.recovery.enabled and self.saved is None

    @property
    def desk(self) -> ScheduledDesk:
        """Where background work is done."""
        return self._state.parts.desk

    @property
    def camera(self) -> Camera:
        """By which features are rectified now."""
        return self._state.parts.calibration.camera

    @property
    def log_focal_sigma(self) -> float | None:
        """Standard deviation of the logarithm of that camera's focal length; None where it is as it was given."""
        return self._state.parts.calibration.log_focal_sigma

    @property
    def hidden(self) -> BoolArray | None:
        """Pixels (H, W) that were found to stand still in the image, and are left out; None while there are none."""
        return self._state.parts.scene.hidden

    @property
    def live(self) -> VisualOdometry | None:
        """The front end of the live submap; None while there is no map."""
        return self._state.live

    @property
    def on_pose(self) -> Callable[[Track], None] | None:
        """Called with each frame's track as soon as it is posed.

        That is before the map grows from it, so that a controller need not wait for a keyframe.
        """
        return self._tracking.on_pose

    @on_pose.setter
    def on_pose(self, on_pose: Callable[[Track], None] | None) -> None:
        self._tracking.on_pose = on_pose

    def graph_of(self, submap: Submap) -> SubmapGraph:
        """Return a factor graph of a submap as it is, live or archived, which tells its covariances.

        It is made anew, in batch, for the caller: the system does not use it.

        Raises
        ------
        SolverError
            If the submap cannot be solved.
        """
        return self._state.parts.open_graph(submap)

    def features_beside(self) -> Callable[[Frame], Frame] | None:
        """Start a process that finds the features of the frame to come while another is tracked.

        Returns
        -------
        callable or None
            Waits for a frame's features, on a thread of the caller's, and returns the frame with them, for `step`. None
            where all is done in one process.
        """
        return None if self._state.parts.open_features is None else self._state.parts.open_features()

    def is_tracking_in_reverse(self, submap_id: int) -> bool:
        """Whether reverse tracking from a submap is under way."""
        return self._recoveries.is_under_way(self.atlas.submaps[submap_id])

    def watch_walks(self, on_walk: Callable[[WalkNews], None]) -> None:
        """Have a function called with how far reverse tracking has come, while it is under way; some news may be lost.

        It may look at the system, and change nothing. Frames are given by their index in the source.
        """
        numbers = self.numbers
        self._state.parts.walk_watch.add(lambda news: on_walk(replace(news, frame=numbers.index_of(news.frame))))

    def step(self, frame: Frame) -> FrameResult:
        """Take one frame through the system.

        Parameters
        ----------
        frame : Frame
            Frames come in any steady order of time.

        Returns
        -------
        FrameResult

        Raises
        ------
        InputError
            If it cannot be the next frame: one that came already, or after the end.
        """
        state, started, self._tracking.posed_at = self._state, time.perf_counter(), None
        source, frame, began_s = frame, self.numbers.numbered(frame), state.pace.clock()
        self.rows[frame.index] = FrameRow(frame.index, frame.timestamp_s, FrameStatus.INITIALISING)
        # 1. Background results come into the map between two frames.
        if (recorded := self.desk.recorded_lateness(source.index)) is not None:
            state.pace.note(recorded.late_s)
        self.desk.begin_frame(source.index, state.pace.in_real_time)
        self._graphs.collect(frame)
        self._places.collect(frame)
        if state.live is not None and self._calibrations.collect(state.live, frame) and state.lost:
            self._begin_anew()
        self._recoveries.in_real_time = state.pace.in_real_time
        self._recoveries.collect(state.live, frame)
        if state.pace.in_real_time:
            held_s = state.pace.clock() - began_s
            state.pace.hold_up(self.desk.lateness(source.index, state.pace.late_s, held_s).held_s)
        if not state.pace.behind:
            self.buffer.settle(SETTLED_A_FRAME)
        # 2. Features, into the buffer that reverse tracking will read.
        with self.timer.measure("features"):
            view = state.parts.view_of(source)
        if isinstance(view, Failure):
            outcome: Track | Failure = view
            self.rows[frame.index].status = FrameStatus.UNREADABLE
            self.events.add(EventKind.UNREADABLE, frame.index, frame.timestamp_s, None, detail=view.detail)
            self.blank.add(frame.index)
        else:
            view = replace(view, index=frame.index)
            self._masking.follow(view)
            self.buffer.append(view)
            # 3. Without a live submap, look for the lost one, or try to start one; with one, track.
            outcome = self._without_map(view) if state.live is None else self._with_map(state.live, view)
            self._note_blank(view, isinstance(outcome, Failure))
            if self._registers:
                self._registering.note(view)
        return self._result(frame, outcome, started)

    def keep(self, frame: Frame) -> None:
        """Keep a frame that came too late to be tracked, instead of a step: reverse tracking may find its pose.

        Parameters
        ----------
        frame : Frame

        Raises
        ------
        InputError
            As `step` does.
        """
        source, frame = frame, self.numbers.numbered(frame)
        self.rows[frame.index] = FrameRow(frame.index, frame.timestamp_s, FrameStatus.DROPPED)
        if not isinstance(late := self._state.parts.keep(source), Failure):
            self.buffer.append_late(replace(late, index=frame.index))

    def join(self, submap_ids: Collection[int]) -> None:
        """Link submaps of another run, which the atlas holds besides the saved map's, with these; end the run.

        No frame is taken before or after. `rows` are the caller's to fill in afterwards: no camera has
        moved from the frames of one run to those of the other.
        """
        last = self._places.join(submap_ids, sorted(self.atlas.submaps.keys() - set(submap_ids)))
        if last is not None:
            self._connections.settle(last)
        self.numbers.end()
        self.desk.close()

    def finish(self, interrupted: bool = False) -> None:
        """End the run: wait, for a limited time, for reverse tracking that is under way; archive the live submap.

        Parameters
        ----------
        interrupted : bool
            Someone is waiting: leave out the last walk, which the growth of the live map would earn, and refinement.
        """
        self.numbers.end()
        self.desk.begin_end(interrupted)
        state, last = self._state, next(reversed(self.rows.values()), None)
        self._graphs.finish(last)
        if state.live is not None and last is not None:
            asks = not interrupted and self.saved is None
            self._calibrations.finish(state.live, last, asks)
        solve = partial(self._graphs.finish, last)
        self._recoveries.finish(state.live, last, interrupted or state.localises, solve)
        if state.live is not None and last is not None:
            self._take_shutter(state.live, last, wait=True)
        if last is not None:
            self._places.finish(last)
        self._graphs.finish(last)
        if state.live is not None and not state.localises:
            self._endings.archive(state.live, "end of sequence")
        if last is not None and not interrupted and not state.localises:
            own = self.atlas.submaps.keys() - self._earlier
            maps = [self.atlas.submaps[m] for m in sorted(own)]
            self._calibrations.settle([each for each in maps if len(each.keyframes) > 1], last)
            self._places.join_rest(own, last)
            link_overlaps(state.record, self._connections, state.config, own, last)
            if self._registers:
                self._registering.finish(last)
            self._calibrations.look_for_zoom(maps)
        self.buffer.clear()  # nothing walks through it any more, and refinement needs the memory
        shapes = {} if interrupted or state.localises else self._endings.refine()
        if last is not None:
            self._places.measure_again(shapes.keys())
            self._connections.settle(last)
            self._endings.pose_frames_anew(shapes)
            self._endings.part_what_lost_its_scale(last)
        state.parts.desk.close()

    # --- without a map

    def _without_map(self, view: View) -> Track | Failure:
        """Find a map again that this frame shows, or start the next one."""
        if track := self._starting.find_again(view):
            return track
        if self._state.localises:
            return Failure(FailureReason.TOO_FEW_MATCHES, "fewer than three frames show a place of the saved map")
        start = self._starting.find_start(view)
        return start if isinstance(start, Failure) else self._begin(start, view)

    def _begin(self, start: Start, view: View) -> Track | Failure:
        """Continue in a new map."""
        outcome = self._starting.begin(start)
        # A background search finds a start that ends some frames back: go on from there.
        for later in [v for v in self.buffer if start.views[-1].index < v.index <= view.index]:
            if self._state.live is None:
                break
            outcome = self._with_map(self._state.live, later)
        return outcome

    # --- with a map

    def _with_map(self, live: VisualOdometry, view: View) -> Track | Failure:
        """Track a frame in the live map, then handle what follows: a break, another map that shows it, a keyframe."""
        state = self._state
        track = self._tracking.track(live, view)
        if isinstance(track, Failure):
            if (found := self._places.seen_instead(live, view)) is None:
                return self._lose(live, view, track)
            state.lost = []
            self.buffer.thaw()
            return self._go_over(found, live, view)
        if state.localises:
            return track
        state.lost = []
        self.buffer.thaw()
        broken = state.motion_watch.judge(view, track.wide, state.record, live.submap)
        if broken is None and (first := self.audit.broken_since(live.submap.id)) is not None:
            detail = f"the images disagree with the map since frame {first}"
            broken = Break(first, Failure(FailureReason.PHOTOMETRIC, detail))
        if broken is not None:
            self._endings.break_at(live, view, broken.first, broken.failure)
            self._begin_anew()
            state.lost = []
            return broken.failure
        if (found := self._places.seen_from(live, track)) is not None:
            return self._go_over(found, live, view)
        if live.reference_id == view.index:
            self._grow(live, view)
        else:
            self._places.catch_up(live, view)
        return track

    def _go_over(self, found: Relocalised, live: VisualOdometry, view: View) -> Track:
        self._endings.archive(live, "an earlier map goes on")
        return self._places.go_over(found, live.submap.id, view)

    def _grow(self, live: VisualOdometry, view: View) -> None:
        """After a keyframe: ask the live map what it knows now, and what it can be linked with; a full one ends."""
        if self._endings.part_where_scale_is_lost(live, view):
            return
        self._ask_shutter(live, view)
        self._calibrations.ask_if_due(live, view)
        if self._endings.is_full(live.submap):
            self._take_open(live, view)
            self._endings.roll_over(live, view)
        else:
            self._recoveries.retry(live.submap, view)
            self._places.note_keyframe(live, view)

    def _ask_shutter(self, live: VisualOdometry, view: View) -> None:
        """Ask the live map how long its images were read; not where open results have the present pixels."""
        if self.saved is None:
            self._shutter_watch.ask_if_due(live)
            self._take_shutter(live, view)

    def _take_shutter(self, live: VisualOdometry, now: FrameStamp, wait: bool = False) -> None:
        """Take in how long its images were read; not while open results for the map have the present pixels."""
        open_ = self._recoveries.is_under_way(live.submap) or self.desk.n_open(JobKind.CALIBRATION, live.submap.id)
        if not open_:
            self._shutter_watch.collect(live, now, wait)

    def _lose(self, live: VisualOdometry, view: View, failure: Failure) -> Track | Failure:
        """Take a frame that was not posed: the map may be relocalised until the next one starts, or it is given up."""
        state = self._state
        self.rows[view.index].status = FrameStatus.LOST
        if state.localises:
            state.live = None
            return failure
        state.lost.append(view)
        if len(state.lost) == 1:
            view = self._begin_to_lose(live, view)
        readout_s = state.parts.shutter.readout_s
        start = self._starting.find_start_instead(view)
        # A graph that has failed, and a map of the pixels of before, are not found again.
        may_return = failure.reason is not FailureReason.SOLVER and state.parts.shutter.readout_s == readout_s
        if start or not may_return or self._has_waited(view):
            self._endings.give_up(live, view, failure)
            state.lost = []
        return failure if isinstance(start, Failure) else self._begin(start, view)

    def _has_waited(self, view: View) -> bool:
        """Return whether the map was lost for `max_lost_s`, and for as many frames as a slow camera takes in it."""
        lost, max_lost_s = self._state.lost, self._state.config.tracking.max_lost_s
        return abs(view.timestamp_s - lost[0].timestamp_s) >= max_lost_s and len(lost) > SLOW_HZ * max_lost_s

    def _begin_to_lose(self, live: VisualOdometry, view: View) -> View:
        """Keep what is buffered, and ask the map about its camera; return the view under the present camera."""
        self.buffer.freeze()
        # A map whose end is suspected is no witness.
        if all(frame.failed for frame in self._state.health.suspected()):
            self._calibrations.ask_at_loss(live, view)
        self._take_open(live, view)
        self._starting.begin_anew([])
        self._starting.foresee()
        return self.buffer.newest(1)[0]

    def _take_open(self, live: VisualOdometry, now: FrameStamp) -> None:
        """Wait, where no clock goes on, for what a map that may end is still to hear of its camera."""
        if not self.pace.in_real_time:
            self._calibrations.collect(live, now, wait=True)
            self._take_shutter(live, now, wait=True)

    def _begin_anew(self) -> None:
        """Look for the next map's start from the frames since the loss on, rectified by the present camera."""
        lost = {view.index for view in self._state.lost}
        self._starting.begin_anew([view for view in self.buffer if view.index in lost])

    # --- records

    def _note_blank(self, view: View, is_lost: bool) -> None:
        """Note lost frames that share too little with what has a pose, and with each other, to be posed by anything.

        Frames that are blurred alike match each other. Tracking may reach them along neighbours that share enough, from
        a frame with a pose. Or there are so many of them that their own map could know its scale, and be joined.
        """
        before, self._before = self._before, view
        n = 0 if before is None or not (is_lost or self._apart) else self._n_shared(before.features, view.features)
        enough = self._state.config.tracking.min_inliers
        if n >= enough and not (is_lost and self._apart and (n < START_POINTS or len(self._apart) < GROUP)):
            self.blank -= self._apart
            self._apart = set()
        elif is_lost:
            self._apart = {view.index} | (self._apart if n >= enough else set())
            self.blank.add(view.index)
        else:
            self._apart = set()

    def _n_shared(self, a: Features, b: Features) -> int:
        enough = self._state.config.tracking.min_inliers
        return len(self._state.parts.match_wide(a, b)) if min(len(a), len(b)) >= enough else 0

    def _result(self, frame: Frame, outcome: Track | Failure, started: float) -> FrameResult:
        row = self.rows[frame.index]
        row.latency_ms = 1e3 * (time.perf_counter() - started)
        posed_at = self._tracking.posed_at
        pose_ms = None if posed_at is None else 1e3 * (posed_at - started)
        pose = self.poses.get(frame.index)
        T_submap_cam = None
        if pose is not None:
            T_submap_cam = self.atlas.submaps[pose.submap_id].resolve_anchor(pose.keyframe_id, pose.T_kf_cam)
        failure = outcome if isinstance(outcome, Failure) else None
        live, covariance_now = self._state.live, None
        if (
            isinstance(outcome, Track)
            and T_submap_cam is not None
            and live is not None
            and live.submap.id == row.submap
        ):
            covariance_now = PoseCovariance.of(live, outcome, T_submap_cam)
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
            row.method,
            "" if pose is None else self._doubt_about(pose.submap_id),
            covariance_now,
        )

    def _doubt_about(self, submap_id: int) -> str:
        if self.audit.doubts(submap_id):
            return str(ReasonCode.PHOTOMETRIC)
        return "" if self._worlds.is_sure(submap_id) else str(ReasonCode.SCALE)
