"""Places: when the live map is compared with earlier places, and when a run continues in an earlier run's map."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from dualslam.atlas.record import FrameStamp
from dualslam.atlas.report import AtlasReport
from dualslam.atlas.trajectory import FramePose
from dualslam.core.events import EventKind
from dualslam.core.interfaces import VisualOdometry
from dualslam.core.types import FrameMethod, FrameStatus, Track, View
from dualslam.map.frame_records import FrameRow
from dualslam.places.handover import Handover
from dualslam.places.revisits import Revisits
from dualslam.places.sightings import Relocalised
from dualslam.recovery.manager import Recoveries
from dualslam.system.state import State

TAKEN_IN_A_FRAME = 1000
"""Landmarks that the index of places takes in at each frame in real time: 2 to 3 ms."""


class PlaceKeeping:
    """Links the live map where it shows a place again, between two frames and not during reverse tracking from it.

    `handover`: none where no map of an earlier run is extended.
    """

    def __init__(self, state: State, revisits: Revisits, recoveries: Recoveries, handover: Handover | None) -> None:
        self._state = state
        self._revisits = revisits
        self._recoveries = recoveries
        self._handover = handover
        self._is_due = False  # for the newest keyframe

    def collect(self, now: FrameStamp) -> None:
        """Let the maps follow what was solved meanwhile, and link the places that were found."""
        live = self._state.live
        with self._state.record.timer.measure("places"):
            report = self._revisits.take_solution(live, now)
        self._settle(report, live)
        self._link(now)

    def _link(self, now: FrameStamp) -> None:
        """Link the places that were found; while reverse tracking is under way, they wait for its end."""
        live = self._state.live
        if live is not None and self._recoveries.is_under_way(live.submap):
            return
        with self._state.record.timer.measure("places"):
            report = self._revisits.collect(live, now)
        self._settle(report, live)

    def _settle(self, report: AtlasReport | None, live: VisualOdometry | None) -> None:
        """Let no walk look any more for what a link has made one map with the live one."""
        if report is not None and live is not None:
            self._recoveries.settle(live)

    def finish(self, last: FrameStamp) -> None:
        """Wait for the places that are being looked for, and link them."""
        live = self._state.live
        self._settle(self._revisits.finish(live, last), live)

    def note_keyframe(self, live: VisualOdometry, view: View) -> None:
        """Look for the places that a new keyframe shows: now; in real time, with the next frame that comes in time."""
        if self._state.pace.in_real_time and not self._is_due:
            self._is_due = True  # a keyframe's frame has enough to do
        else:
            self._revisit(live, view)

    def catch_up(self, live: VisualOdometry, view: View) -> None:
        """Do a part of what real time has left to do: first take in what the map has gained, then look for places."""
        if not self._state.pace.in_real_time or self._state.pace.behind:
            return
        with self._state.record.timer.measure("places"):
            n_taken = self._revisits.take_in(live.submap, TAKEN_IN_A_FRAME)
        if self._is_due and not n_taken:
            self._revisit(live, view)

    def _revisit(self, live: VisualOdometry, view: View) -> None:
        """Link the live map where its newest keyframe shows a place again."""
        self._is_due = False
        with self._state.record.timer.measure("places"):
            self._revisits.note_keyframe(live, TAKEN_IN_A_FRAME if self._state.pace.in_real_time else None)
        self._link(view)

    def join(self, submap_ids: Iterable[int], among: Collection[int]) -> FrameStamp | None:
        """Link archived submaps with others, of another run, where keyframes show the same places.

        Returns the last keyframe that was asked about.
        """
        now = None
        for m in submap_ids:
            submap = self._state.record.atlas.submaps[m]
            newest = max(submap.keyframes)
            now = FrameRow(newest, submap.keyframes[newest].timestamp_s, FrameStatus.TRACKED)
            asking = self._state.parts.new_relocaliser(submap, self._state.parts.new_graph())
            for k in sorted(submap.keyframes.keys() - submap.condemned):
                asking.start_at(k)
                with self._state.record.timer.measure("places"):
                    self._revisits.note_keyframe(asking, among=among)
                    self._revisits.finish(asking, now)
        return now

    def join_rest(self, own: Collection[int], now: FrameStamp) -> None:
        """Join this run's submaps that are still apart, where they show the same places; `own`: their ids."""
        with self._state.record.timer.measure("places"):
            self._revisits.join_rest(own, now)

    def measure_again(self, refined: Collection[int]) -> None:
        """Measure the links of places again in submaps that are `refined`."""
        with self._state.record.timer.measure("places"):
            self._revisits.measure_again(refined)

    # --- a place that an earlier run has mapped

    def keyframe_waits(self, odometry: VisualOdometry, track: Track) -> bool:
        """Whether a keyframe is not to be made yet, since a map of an earlier run seems to have the place already."""
        is_live = odometry is self._state.live
        if self._handover is None or not is_live or self._recoveries.is_under_way(odometry.submap):
            return False
        with self._state.record.timer.measure("places"):
            return self._handover.waits(track, odometry, self._state.parts.K, self._state.pace.in_real_time)

    def seen_from(self, live: VisualOdometry, track: Track) -> Relocalised | None:
        """Return the submap of an earlier run that shows what the live one has come to, once that is sure."""
        if self._handover is None:
            return None
        with self._state.record.timer.measure("places"):
            return self._handover.follow(track, live)

    def seen_instead(self, live: VisualOdometry, view: View) -> Relocalised | None:
        """Return the submap of an earlier run that the live one was about to switch to, where it shows the frame."""
        if self._handover is None:
            return None
        with self._state.record.timer.measure("places"):
            return self._handover.follow_alone(view, live)

    def go_over(self, found: Relocalised, from_submap: int, view: View) -> Track:
        """Continue in the submap of an earlier run that has this place already; the live one is archived."""
        state = self._state
        state.live, submap, track = found.odometry, found.odometry.submap, found.track
        reference = state.live.reference_id
        pose = FramePose(view.index, view.timestamp_s, submap.id, reference, state.live.relative_pose(track))
        state.record.pose(pose, track.n_matches, track.n_inliers, method=FrameMethod.WIDE)
        state.record.event(
            EventKind.RELOCALISED,
            view,
            submap.id,
            n_inliers=track.n_inliers,
            other_frame=reference,
            frames=len(found.earlier) + 1,
            from_submap=from_submap,
        )
        state.begin_health()
        return track
