"""Decisions of a run: one record each, with the numbers that were compared and their thresholds.

Nothing is recorded unless a run asks for it. `dualslam explain` prints the records of a frame as sentences.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dualslam.core.types import Failure


class DecisionKind(StrEnum):
    """The `what` field of a line of ``decisions.jsonl``."""

    FRAME = "frame"
    KEYFRAME = "keyframe"
    START = "start"
    WALK = "walk"
    LINK = "link"
    PLACE = "place"


@dataclass(frozen=True, slots=True)
class Gate:
    """A number compared with a threshold."""

    name: str  # with its unit
    value: float
    sign: str  # ``>``, ``>=``, ``<`` or ``<=``: the comparison that passes
    threshold: float

    @property
    def passed(self) -> bool:
        """Whether the comparison holds; it does not for NaN."""
        value, threshold = self.value, self.threshold
        if self.sign in (">", ">="):
            return value > threshold or (self.sign == ">=" and value == threshold)
        return value < threshold or (self.sign == "<=" and value == threshold)

    def as_dict(self) -> dict[str, Any]:
        """Return the object that ``decisions.jsonl`` holds."""
        return {**asdict(self), "passed": self.passed}


@dataclass(frozen=True, slots=True)
class Ruling:
    """The answer to a yes-or-no question, with the comparisons that led to it. It is true or false itself."""

    holds: bool
    gates: tuple[Gate, ...] = ()
    detail: str = ""  # what else led to it

    def __bool__(self) -> bool:
        return self.holds


@dataclass(frozen=True, slots=True)
class Decision:
    """One decision."""

    frame: int  # index of the frame
    what: DecisionKind
    accepted: bool  # whether the frame was posed, the keyframe made, the map started, the maps linked
    submap: int | None = None
    gates: tuple[Gate, ...] = ()
    # Code and sentence of a refusal.
    reason: str = ""
    detail: str = ""
    data: dict[str, Any] = field(default_factory=dict)  # other numbers of the decision

    @classmethod
    def refused(cls, frame: int, what: DecisionKind, submap: int | None, why: Failure) -> Decision:
        """Make the decision that a failure stands for."""
        return cls(frame, what, False, submap, why.gates, str(why.reason), why.detail, dict(why.numbers))

    def as_dict(self) -> dict[str, Any]:
        """Return the flat object that ``decisions.jsonl`` holds."""
        return {
            "frame": self.frame,
            "what": str(self.what),
            "accepted": self.accepted,
            "submap": self.submap,
            "reason": self.reason,
            "detail": self.detail,
            "gates": [gate.as_dict() for gate in self.gates],
            "data": self.data,
        }


class DecisionSink:
    """Passes decisions on to the listener `write`, if there is one; else they are not made up either."""

    def __init__(self) -> None:
        self.write: Callable[[Decision], None] | None = None

    @property
    def is_open(self) -> bool:
        """Whether decisions are wanted."""
        return self.write is not None

    def note(self, decision: Decision) -> None:
        """Pass a decision on."""
        if self.write is not None:
            self.write(decision)
