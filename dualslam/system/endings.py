"""How a live map ends: its track is lost, it contradicts itself, it has lost its scale, or it is full."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Set

from dualslam.atlas.atlas import Link
from dualslam.atlas.connections import Connections
from dualslam.atlas.endings import archive, part_off
from dualslam.atlas.propagation import pose_frames_anew, rows_of_frames
from dualslam.atlas.record import FrameStamp
from dualslam.core.errors import SolverError
from dualslam.core.events import EventKind
from dualslam.core.interfaces import VisualOdometry
from dualslam.core.types import Failure, FailureReason, View
from dualslam.map.split import next_submap, submap_of
from dualslam.map.submap import Submap
from dualslam.places.sightings import Sightings
from dualslam.recovery.fusion import drop_corrupted
from dualslam.recovery.manager import Recoveries
from dualslam.recovery.scale_watch import ScaleLoss, ScaleWatch, part_what_lost_its_scale
from dualslam.system.health import count_signs
from dualslam.system.state import State

log = logging.getLogger(__name__)

ROOM_TO_COME_BACK = 1.2
"""A full submap of an earlier run takes so many times `graph.max_keyframes`: later visits add little to a mapped place
(the first one about a tenth, hardly any the next). That is no reason to map it once more."""


class Endings:
    """Archives live maps, and continues in the next (`earlier`: those of earlier runs) where the end is no loss."""

    def __init__(
        self, state: State, recoveries: Recoveries, connections: Connections, sightings: Sightings, earlier: Set[int]
    ) -> None:
        self._state = state
        self._recoveries = recoveries
        self._connections = connections
        self._sightings = sightings
        self._earlier = earlier
        self._scale_watch = ScaleWatch(state.config.linking, state.parts.desk)

    def archive(self, live: VisualOdometry, why: str) -> None:
        """Archive the live submap; what only a live one could use is no longer computed."""
        archive(self._state.record, live.submap, live.graph, why)
        self._state.parts.desk.withdraw(live.submap.id)

    # --- with the track

    def give_up(self, live: VisualOdometry, view: View, failure: Failure) -> None:
        """Declare the track failed: archive the submap whole. Reverse tracking may link it."""
        state, lost = self._state, self._state.lost
        suspected = state.health.suspected()
        onset = min([lost[0].index, *(frame.index for frame in suspected)])
        state.record.event(
            EventKind.FAILED,
            view,
            live.submap.id,
            reason=str(failure.reason),
            detail=failure.detail,
            lost_since=lost[0].index,
            suspected_since=onset,
            signs=count_signs(frame for frame in suspected if not frame.failed),
            **failure.numbers,
        )
        self.archive(live, "track lost")
        state.motion_watch.end()
        self._recoveries.declare_lost(live.submap.id, onset, str(failure.reason), lost[0].index)
        state.live = None
        state.begin_health()
        # Not where two poses stood.
        if failure.reason in (FailureReason.LOOK_ALIKE, FailureReason.LEAP):
            self._sightings.avoid(live.submap.id)

    def break_at(self, live: VisualOdometry, view: View, first: int, failure: Failure) -> None:
        """End a map that is broken since frame `first`; reverse tracking will pose the frames since then."""
        state = self._state
        state.lost = [buffered for buffered in state.buffer if buffered.index >= first] or [view]
        state.buffer.freeze()
        drop_corrupted(state.record, live.submap.id, first)
        live.submap.condemn({k for k in live.submap.keyframes if k >= first})
        self.give_up(live, view, failure)

    # --- where it has lost its scale

    def part_where_scale_is_lost(self, live: VisualOdometry, view: View) -> bool:
        """End a map where it has lost its scale, and continue in a new one from there; return whether it was done.

        Reverse tracking from the new one may link the two. Not while reverse tracking is about to change the map.
        """
        if self._recoveries.is_under_way(live.submap):
            return False
        record = self._state.record
        with record.timer.measure("audit"):
            loss = self._scale_watch.judge(live.submap, record.atlas.believed)
        return loss is not None and self._part_at(live, view, loss)

    def _part_at(self, live: VisualOdometry, view: View, loss: ScaleLoss) -> bool:
        state, record = self._state, self._state.record
        old, graph = live.submap, state.parts.new_graph()
        rest = [k for k in old.keyframes if k >= loss.first]
        submap = submap_of(old, len(record.atlas.submaps), rest)
        try:
            graph.rebuild(submap)
        except SolverError as error:
            log.warning("submap %d is not split where it has lost its scale: %s", old.id, error)
            return False
        record.event(
            EventKind.FAILED,
            view,
            old.id,
            reason=str(FailureReason.SCALE_LOST),
            detail=loss.detail,
            lost_since=loss.first,
            suspected_since=loss.since,
            sigma_scale=loss.sigma,
        )
        self.archive(live, "scale lost")
        part_off(record, old, submap, max(old.keyframes.keys() - submap.keyframes.keys()))
        n = int(submap.landmarks["alive"].sum())
        record.event(EventKind.REINITIALISED, view, submap.id, first_view=loss.first, n_points=float(n))
        state.live = state.parts.new_odometry(submap, graph)
        state.live.start_at(view.index)
        state.motion_watch.end()
        self._recoveries.declare_lost(old.id, loss.since, str(FailureReason.SCALE_LOST), loss.first)
        first = next((buffered for buffered in state.buffer if buffered.index == loss.first), None)
        if first is not None:
            self._recoveries.start(submap, first)
            self._recoveries.collect(state.live, view)
        return True

    def refine(self) -> dict[int, float]:
        """Refine this run's submaps in batch, at the end of the run, now that all they have seen is in them.

        Returns for each the shape of the loss under which that was done, for `pose_frames_anew`.
        """
        record, min_inliers = self._state.record, self._state.config.health.min_inliers
        shapes = {}
        with record.timer.measure("final refinement"):
            for m in sorted(record.atlas.submaps.keys() - self._earlier):
                submap = record.atlas.submaps[m]
                before, frames = submap.copy(), rows_of_frames(record, submap, len(submap.keyframes), min_inliers)
                try:
                    shapes[m] = self._state.parts.refine_at_end(submap, frames=frames)
                except SolverError as error:
                    log.warning("submap %d stays as tracking has left it: %s", m, error)
                    continue
                self._connections.carry(before, submap)
        return shapes

    def pose_frames_anew(self, shapes: Mapping[int, float]) -> None:
        """Pose the frames of refined submaps by what they were tracked by: landmarks, where these have come to be."""
        record, min_inliers = self._state.record, self._state.config.health.min_inliers
        with record.timer.measure("final refinement"):
            for m, shape in shapes.items():
                pose_frames_anew(record, record.atlas.submaps[m], shape, min_inliers)

    def part_what_lost_its_scale(self, last: FrameStamp) -> None:
        """Part this run's archived maps where no link holds what lies beyond a loss of scale, at the end of the run."""
        state, record = self._state, self._state.record
        if state.localises:
            return
        with record.timer.measure("audit"):
            for m in sorted(record.atlas.submaps.keys() - self._earlier):
                part_what_lost_its_scale(record, m, state.config.linking, last)

    # --- full

    def is_full(self, submap: Submap) -> bool:
        """Whether a submap takes no more keyframes; one that was full when an earlier run left it has room."""
        share = ROOM_TO_COME_BACK if submap.id in self._earlier else 1.0
        return len(submap.keyframes) >= int(share * self._state.config.graph.max_keyframes)

    def roll_over(self, live: VisualOdometry, view: View) -> None:
        """Continue in a new submap that shares its first keyframes with the full one: no failure, and a stiff link."""
        state, record = self._state, self._state.record
        submap = next_submap(live.submap, len(record.atlas.submaps), state.config.graph.rollover_keyframes, view.index)
        graph = state.parts.new_graph()
        try:
            graph.rebuild(submap)
        except SolverError as error:
            log.warning("submap %d stays open beyond its cap: %s", live.submap.id, error)
            return
        record.atlas.add(submap)
        record.event(EventKind.ROLLED_OVER, view, submap.id, from_submap=live.submap.id)
        self.archive(live, "full")
        link = Link.of_rollover(live.submap, submap)
        state.live = state.parts.new_odometry(submap, graph)
        state.live.start_at(list(submap.keyframes)[-1])
        if not self._connections.connect([link], view):  # it is the identity all the same, and solved with the next
            record.atlas.link(link)
            log.warning("submap %d goes on from submap %d by their shared keyframes alone, unsolved", link.b, link.a)
