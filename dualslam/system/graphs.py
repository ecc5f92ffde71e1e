"""Graphs that are solved in the background: submaps move to what was solved, between two frames."""

from __future__ import annotations

from collections.abc import Iterable

from dualslam.atlas.propagation import propagate_links
from dualslam.atlas.record import FrameStamp
from dualslam.core.events import EventKind
from dualslam.map.graph_beside import Moved
from dualslam.map.submap_delta import drop_dead_rows
from dualslam.system.state import State


class GraphKeeping:
    """Moves submaps to what their graphs have solved meanwhile; inline, where nothing is, it only clears away."""

    def __init__(self, state: State) -> None:
        self._state = state

    def collect(self, now: FrameStamp) -> None:
        """Move submaps to what their graphs have solved meanwhile, and send the graphs what is new.

        What is dead in the live submap leaves it here, too: between two frames no one holds rows by their numbers.
        """
        state = self._state
        graphs, submaps = state.parts.graphs, state.record.atlas.submaps
        if graphs is None:
            if state.live is not None:
                drop_dead_rows(state.live.submap, state.live.graph)
            return
        graphs.in_real_time = state.pace.in_real_time
        with state.record.timer.measure("graph (late)"):
            if state.live is not None:
                state.pace.note_lag(graphs.lag(state.live.submap))
            self._follow(graphs.collect(submaps), now)

    def finish(self, last: FrameStamp | None) -> None:
        """Wait for what is being solved."""
        graphs = self._state.parts.graphs
        if graphs is not None and last is not None:
            self._follow(graphs.finish(self._state.record.atlas.submaps), last)

    def _follow(self, moved: Iterable[Moved], now: FrameStamp) -> None:
        record = self._state.record
        for each in moved:
            propagate_links(record.atlas, each.before, each.submap)
            live = self._state.live
            if live is not None and live.submap is each.submap:
                live.adopt(live.graph, each.before)
            if each.rebuilt:
                record.event(EventKind.GRAPH_REBUILT, now, each.submap.id)
