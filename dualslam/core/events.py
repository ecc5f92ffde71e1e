"""The typed event log of a run: what happened, at which frame, in which submap, and the numbers that belong to it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from dualslam.core.decisions import Decision, DecisionKind, DecisionSink, Gate


class EventKind(StrEnum):
    """The `event` field of a line of ``events.jsonl``."""

    INITIALISED = "initialised"
    INITIALISATION_REFUSED = "initialisation_refused"
    GAP_RELOCALISED = "gap_relocalised"
    FAILED = "failed"
    ARCHIVED = "archived"
    REINITIALISED = "reinitialised"
    RELOCALISED = "relocalised"
    ROLLED_OVER = "rolled_over"
    GRAPH_REBUILT = "graph_rebuilt"
    CALIBRATED = "calibrated"
    CALIBRATION_KEPT = "calibration_kept"
    FOCAL_CHANGED = "focal_changed"
    SHUTTER_FOUND = "shutter_found"
    MASKED = "masked"
    CAMERA_STANDS = "camera_stands"
    CAMERA_MOVES = "camera_moves"
    UNREADABLE = "unreadable"
    RECOVERY_STARTED = "recovery_started"
    RECOVERY_ATTEMPT = "recovery_attempt"
    RECOVERY_FAILED = "recovery_failed"
    ATTEMPT_UNAVAILABLE = "attempt_unavailable"
    RECOVERY_ENDED = "recovery_ended"
    LINKED = "linked"
    RELINKED = "relinked"
    LINK_REFUSED = "link_refused"
    FUSED = "fused"
    CUT = "cut"
    REGISTERED = "registered"
    REGISTRATION_REFUSED = "registration_refused"
    LOOP_CLOSED = "loop_closed"
    LOOP_REFUSED = "loop_refused"
    MERGED = "merged"
    ATLAS_SOLVED = "atlas_solved"
    CONNECTION_REJECTED = "connection_rejected"
    CONNECTION_READMITTED = "connection_readmitted"
    INTERRUPTED = "interrupted"


@dataclass(frozen=True, slots=True)
class Event:
    """One thing that happened."""

    event: EventKind
    frame: int  # index of the frame in the source
    timestamp_s: float
    submap: int | None
    data: dict[str, Any] = field(default_factory=dict)
    """What belongs to this kind of event: plain numbers, strings and lists."""
    gates: tuple[Gate, ...] = ()
    """Comparisons behind it. They go into ``decisions.jsonl``, not into ``events.jsonl``."""

    def as_dict(self) -> dict[str, Any]:
        """Return the flat object that ``events.jsonl`` holds."""
        return {
            "event": str(self.event),
            "frame": self.frame,
            "timestamp_s": self.timestamp_s,
            "submap": self.submap,
            **self.data,
        }


_DECIDED = {
    EventKind.INITIALISED: (DecisionKind.START, True),
    EventKind.REINITIALISED: (DecisionKind.START, True),
    EventKind.LINKED: (DecisionKind.LINK, True),
    EventKind.RELINKED: (DecisionKind.LINK, True),
    EventKind.LINK_REFUSED: (DecisionKind.LINK, False),
    EventKind.LOOP_CLOSED: (DecisionKind.PLACE, True),
    EventKind.MERGED: (DecisionKind.PLACE, True),
    EventKind.LOOP_REFUSED: (DecisionKind.PLACE, False),
}
"""Events that tell of a decision, and whether it was a yes. `recovery_attempt` says so itself."""


class EventLog:
    """Append-only list of events; `decisions` receives those of a run, with what events tell of."""

    def __init__(self) -> None:
        self._events: list[Event] = []
        self.decisions = DecisionSink()

    def add(
        self,
        kind: EventKind,
        frame: int,
        timestamp_s: float,
        submap: int | None,
        gates: tuple[Gate, ...] = (),
        /,
        **data: Any,
    ) -> Event:
        """Append an event and return it."""
        event = Event(kind, frame, timestamp_s, submap, data, gates)
        self._events.append(event)
        if self.decisions.is_open:
            self._note_decision(event)
        return event

    def _note_decision(self, event: Event) -> None:
        data = dict(event.data)
        if event.event is EventKind.RECOVERY_ATTEMPT:
            what, accepted = DecisionKind.WALK, data["verdict"] == "linked"
        elif event.event in _DECIDED:
            what, accepted = _DECIDED[event.event]
        else:
            return
        reason, detail = data.pop("reason", ""), data.pop("detail", "") or data.pop("verdict", "")
        self.decisions.note(Decision(event.frame, what, accepted, event.submap, event.gates, reason, detail, data))

    def __iter__(self) -> Iterator[Event]:
        return iter(self._events)

    def __len__(self) -> int:
        return len(self._events)

    def of_kind(self, *kinds: EventKind) -> list[Event]:
        """Return the events of the given kinds, in order."""
        return [e for e in self._events if e.event in kinds]
