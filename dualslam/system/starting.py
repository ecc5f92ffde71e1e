"""Without a live map: a lost one, or any other, is found again, or the next one starts."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from dualslam.atlas.trajectory import FramePose
from dualslam.core.decisions import Decision, DecisionKind, Gate
from dualslam.core.errors import SolverError
from dualslam.core.events import EventKind
from dualslam.core.geometry import se3
from dualslam.core.interfaces import START_REACH, VisualOdometry
from dualslam.core.jobs import JobKind
from dualslam.core.types import Failure, FailureReason, FrameMethod, Start, Track, View
from dualslam.map.frame_observations import FrameObservations
from dualslam.map.submap import Submap
from dualslam.places.sightings import Sightings
from dualslam.recovery.manager import Recoveries
from dualslam.system.camera.shutter_watch import correct_views
from dualslam.system.state import State
from dualslam.system.tracking import Tracking

EARLY_FRAMES = 8
"""Lost frames up to which no pair of them lies eight apart, as the pairs do that a start is mostly made of."""
FIRM_SIGMA_DEG = 0.25
"""Of the direction of translation of a start, up to which reverse tracking from it crosses a gap as well as from a
later one. Over 1 to 1.5 s without frames (`kitti_03`) such starts gave the link's scale to 0.6 to 1.0 %, others to 1.1
to 1.7 %."""

REACH_IN_TIME = 64
"""As `START_REACH` in real time, of frames whose pixels have changed: three seconds of them take 0.2 s."""
FORESEEN = 3
"""Frames before a loss that reverse tracking over it asks for: two that cross the gap, and one to go on from there."""


class Starting:
    """Finds a map again, or starts one.

    `sightings`: tells whether any submap shows a frame.
    """

    def __init__(self, state: State, tracking: Tracking, recoveries: Recoveries, sightings: Sightings) -> None:
        self._state = state
        self._tracking = tracking
        self._recoveries = recoveries
        self._sightings = sightings
        self._starter = state.parts.new_starter()
        self._n_without_map = 0  # frames
        self._is_held_back = False  # frames are, until the shutter is known
        self._since_s: float | None = None  # stamp of the first of them for which a start was looked for
        self._foresee: Callable[[View], None] | None = None  # for the first frame after a loss that shows something

    def begin_anew(self, lost: list[View]) -> None:
        """Look for the next map's start from these frames on."""
        self._since_s, self._is_held_back = None, False
        self._collect(lost)

    def begin_again(self) -> None:
        """Look for the next map's start anew, as the pixels of the frames that are buffered have changed."""
        self._collect(self._without_map_yet(self._state.buffer.newest(self._reach)))

    @property
    def _reach(self) -> int:
        return REACH_IN_TIME if self._state.pace.in_real_time else START_REACH

    def _without_map_yet(self, views: Iterable[View]) -> list[View]:
        rows = self._state.record.rows
        return [view for view in views if rows[view.index].submap is None]

    def _collect(self, views: list[View]) -> None:
        self._starter = self._state.parts.new_starter()
        for view in views:
            self._starter.collect(view)

    # --- a map that is there

    def find_again(self, view: View) -> Track | None:
        """Continue in any submap that a few frames in a row show: at once in a saved map, else where no map starts."""
        state, record = self._state, self._state.record
        self._n_without_map += len(view.features) >= state.config.tracking.min_inliers
        recovery = state.config.recovery
        after = 0 if state.saved is not None else recovery.relocalise_after if recovery.enabled else None
        if not record.atlas.submaps or after is None or self._n_without_map <= after:
            return None
        with record.timer.measure("places"):
            found = self._sightings.sighted(view, state.parts.K)
        if found is None:
            return None
        state.live, submap = found.odometry, found.odometry.submap
        self._n_without_map = 0
        state.begin_health()
        for track, T_kf_cam in (*found.earlier, (found.track, state.live.relative_pose(found.track))):
            at = track.view
            pose = FramePose(at.index, at.timestamp_s, submap.id, found.reference, T_kf_cam)
            seen = FrameObservations.of(at.features, track.landmark_ids, submap.id)
            record.pose(pose, track.n_matches, track.n_inliers, None if state.localises else seen, FrameMethod.WIDE)
        first = found.earlier[0][0]
        record.event(
            EventKind.RELOCALISED,
            view,
            submap.id,
            n_inliers=first.n_inliers,
            other_frame=found.reference,
            frames=len(found.earlier) + 1,
        )
        if not state.localises:
            self._go_on(submap, first.view)
        return found.track

    def _go_on(self, submap: Submap, since: View) -> None:
        """Continue in a submap that was found again, and doubt it until the camera's velocity has agreed."""
        self._state.motion_watch.begin(since)
        self._recoveries.found_again(submap)
        self._state.buffer.thaw()

    # --- a new map

    def find_start(self, view: View) -> Start | Failure:
        """Look for the start of a map that ends at this frame, or at one before it if it was looked for meanwhile."""
        self._foresee_from(view)
        state, shutter = self._state, self._state.parts.shutter
        if (refused := state.parts.scene.refuse_start()) is not None:
            self._starter.collect(view)
            return refused
        if self._since_s is None:
            self._since_s = view.timestamp_s
        with state.record.timer.measure("shutter"):
            readout_s = shutter.readout_s
            may_start = shutter.may_start(view, state.parts.calibration.camera)
            tried = self._correct_shutter() if shutter.readout_s != readout_s else [view]
        if not may_start:
            self._is_held_back = True
            return Failure(FailureReason.DOUBTFUL_INITIALISATION, "a fast turn before the shutter is known")
        with state.record.timer.measure("initialisation"):
            for each in tried:
                start = self._starter.add(each, each.timestamp_s - self._since_s, briefly=state.pace.in_real_time)
                if start:
                    break
        if isinstance(start, Failure) and start.reason is FailureReason.DOUBTFUL_INITIALISATION:
            state.record.event(EventKind.INITIALISATION_REFUSED, view, None, reason=start.detail, **start.numbers)
        if isinstance(start, Failure):
            self._note_refused(view, start)
        return start

    def _note_refused(self, view: View, why: Failure) -> None:
        decisions = self._state.record.events.decisions
        if decisions.is_open:
            decisions.note(Decision.refused(view.index, DecisionKind.START, None, why))

    def foresee(self) -> None:
        """Let what the next walk may ask for on either side of a loss be found while there is no map to walk from."""
        self._foresee = foresee = self._state.parts.foresee
        if foresee is None:
            return
        *before, _ = self._state.buffer.newest(FORESEEN + 1)
        for view in reversed(before):
            foresee(view)

    def _foresee_from(self, view: View) -> None:
        if self._foresee is not None and len(view.features) >= self._state.config.tracking.min_inliers:
            self._foresee(view)
            self._foresee = None

    def find_start_instead(self, view: View) -> Start | Failure:
        """Look for the start of the next map while the present one is lost and may still be relocalised.

        An early one is made of frames close together, and must be firm: it is to be tracked back from.
        """
        self._foresee_from(view)
        present = None if self._state.live is None else self._state.live.submap.id
        if self._state.parts.desk.n_open(JobKind.CALIBRATION, present):  # what it says of its camera is for both
            self._starter.collect(view)
            return Failure(FailureReason.BUSY, "the camera is being asked for")
        start, is_early = self.find_start(view), len(self._state.lost) <= EARLY_FRAMES
        if is_early and start and start.numbers.get("direction_sigma_deg", 0.0) > FIRM_SIGMA_DEG:
            detail = "frames farther apart would know their motion better"
            numbers = start.numbers
            sigma = Gate(
                "sigma of the direction of translation in degrees", numbers["direction_sigma_deg"], "<=", FIRM_SIGMA_DEG
            )
            start = Failure(FailureReason.DOUBTFUL_INITIALISATION, detail, gates=(sigma,))
            self._note_refused(view, start)
        return start

    def _correct_shutter(self) -> list[View]:
        """Take the shutter that was found out of the frames so far; the starter begins anew.

        Returns the frames to be tried: the newest, and before it those that no start was looked for in, as the shutter
        was not known. In real time there is no time for these.
        """
        state, shutter = self._state, self._state.parts.shutter
        *_, newest = state.buffer.newest(1)
        state.record.event(EventKind.SHUTTER_FOUND, newest, None, readout_s=shutter.readout_s)
        correct_views(state.buffer, shutter, state.parts.calibration.camera)
        *waiting, newest = state.buffer.newest(self._reach + 1)
        tries_again, self._is_held_back = self._is_held_back and not state.pace.in_real_time, False
        free = self._without_map_yet(waiting)
        self._collect([] if tries_again else free)
        return [*(free if tries_again else []), newest]

    def begin(self, start: Start) -> Track | Failure:
        """Make a submap of a start, and pose the frames before and between by reverse tracking over the buffer."""
        state, record, view = self._state, self._state.record, start.views[-1]
        submap = Submap.from_start(start, len(record.atlas.submaps), state.parts.K)
        graph = state.parts.new_graph()
        odometry = state.parts.new_odometry(submap, graph)
        try:
            with record.timer.measure("graph"):
                estimate = graph.update(submap)
                submap.apply_estimate(*estimate.values)
                odometry.start_at(view.index)
            with record.timer.measure("mapping"):
                odometry.grow_weak_start(estimate.noise2)
        except SolverError as error:
            return Failure(FailureReason.SOLVER, str(error), start.numbers)
        self._record_start(submap, start)
        self._track_in(odometry, view)
        ids = submap.landmark_of[view.index]
        n = int((ids >= 0).sum())
        T_cam_submap = se3.inverse(submap.T_submap_kf[view.index])
        return Track(
            view, T_cam_submap, T_cam_submap, ids, np.zeros(0, np.int64), n, n, 1.0, False, np.zeros((se3.DOF, se3.DOF))
        )

    def _record_start(self, submap: Submap, start: Start) -> None:
        record = self._state.record
        kind = EventKind.INITIALISED if not record.atlas.submaps else EventKind.REINITIALISED
        record.atlas.add(submap)
        for k, keyframe in submap.keyframes.items():
            seen = FrameObservations.of(keyframe.features, submap.landmark_of[k], submap.id)
            n = len(seen.landmark_ids)
            pose = FramePose(k, keyframe.timestamp_s, submap.id, k, se3.IDENTITY)
            record.pose(pose, n, n, seen, FrameMethod.WIDE)
        with record.timer.measure("audit of images"):
            self._state.audit.begin(submap, start.views)
        told = {"frontend": self._state.config.frontend.name, "first_view": start.views[0].index}
        record.event(kind, start.views[-1], submap.id, **told, **start.numbers)

    def _track_in(self, odometry: VisualOdometry, view: View) -> None:
        """Let a new submap be the live one, and reverse tracking start from it."""
        state = self._state
        state.live = odometry
        self._n_without_map = 0
        self._collect([])  # lets go of the views before the start
        state.begin_health()
        self._recoveries.start(odometry.submap, view)
        self._recoveries.collect(odometry, view)
        state.buffer.thaw()
