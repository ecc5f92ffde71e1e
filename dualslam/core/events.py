"""The typed event log of a run: what happened, at which frame, in which submap, and the numbers that belong to it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any


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
    SHUTTER_FOUND = "shutter_found"
    MASKED = "masked"
    CAMERA_STANDS = "camera_stands"
    CAMERA_MOVES = "camera_moves"
    UNREADABLE = "unreadable"
    RECOVERY_STARTED = "recovery_started"
    RECOVERY_ATTEMPT = "recovery_attempt"
    RECOVERY_FAILED = "recovery_failed"
    RECOVERY_ENDED = "recovery_ended"
    LINKED = "linked"
    LINK_REFUSED = "link_refused"
    FUSED = "fused"
    ABSORBED = "absorbed"
    CUT = "cut"
    LOOP_CLOSED = "loop_closed"
    LOOP_REFUSED = "loop_refused"
    MERGED = "merged"
    ATLAS_SOLVED = "atlas_solved"
    CONNECTION_REJECTED = "connection_rejected"
    CONNECTION_READMITTED = "connection_readmitted"
    INTERRUPTED = "interrupted"


@dataclass(frozen=True, slots=True)
class Event:
    """One thing that happened.

    Attributes
    ----------
    event : EventKind
    frame : int
        Index of the frame in the source.
    timestamp_s : float
    submap : int or None
    data : dict
        What belongs to this kind of event: plain numbers, strings and lists.
    """

    event: EventKind
    frame: int
    timestamp_s: float
    submap: int | None
    data: dict[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return the flat object that ``events.jsonl`` holds."""
        return {
            "event": str(self.event),
            "frame": self.frame,
            "timestamp_s": self.timestamp_s,
            "submap": self.submap,
            **self.data,
        }


class EventLog:
    """Append-only list of events."""

    def __init__(self) -> None:
        self._events: list[Event] = []

    def add(self, kind: EventKind, frame: int, timestamp_s: float, submap: int | None, **data: Any) -> Event:
        """Append an event and return it."""
        event = Event(kind, frame, timestamp_s, submap, data)
        self._events.append(event)
        return event

    def __iter__(self) -> Iterator[Event]:
        return iter(self._events)

    def __len__(self) -> int:
        return len(self._events)

    def of_kind(self, *kinds: EventKind) -> list[Event]:
        """Return the events of the given kinds, in order."""
        return [e for e in self._events if e.event in kinds]
