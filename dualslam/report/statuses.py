"""The statuses of frames, and events, in words and classes. Never by colour alone: words and shapes too."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dualslam.core.types import FrameStatus
from dualslam.report.markup import number

MEANING: dict[FrameStatus, str] = {
    FrameStatus.TRACKED: "posed by the live front end",
    FrameStatus.RECOVERED: "posed by reverse tracking",
    FrameStatus.BYPASSED: "end of a lost map, posed in the new one",
    FrameStatus.LOST: "no pose: the map could not explain the frame",
    FrameStatus.INITIALISING: "no pose: there was no map",
    FrameStatus.DROPPED: "came too late to be looked at",
    FrameStatus.UNREADABLE: "the image could not be read",
}
WITHOUT_POSE = (FrameStatus.LOST, FrameStatus.INITIALISING, FrameStatus.DROPPED, FrameStatus.UNREADABLE)
_WHERE = frozenset({"event", "frame", "timestamp_s", "submap"})


@dataclass(frozen=True, slots=True)
class Stretch:
    """Neighbouring items ``start <= i < stop`` of equal value."""

    value: object
    start: int
    stop: int

    def __len__(self) -> int:
        return self.stop - self.start


def stretches(values: Sequence[object]) -> Iterator[Stretch]:
    """Yield the longest stretches of equal neighbours, in order."""
    start = 0
    for i in range(1, len(values) + 1):
        if i == len(values) or values[i] != values[start]:
            yield Stretch(values[start], start, i)
            start = i


def count(n: int, one: str, many: str | None = None) -> str:
    """Return a number with its noun."""
    return f"{n} {one if n == 1 else many or one + 's'}"


def seen_again(summary: Mapping[str, Any], relocalisations_more: int = 0) -> list[str]:
    """Return how often a place was revisited, by outcome; nothing for outcomes that never occurred."""
    nouns = {"relocalised": "relocalisation", "loops": "loop", "merges": "merge"}
    found = {key: summary.get(key) or 0 for key in nouns}
    found["relocalised"] += relocalisations_more
    return [count(n, nouns[key]) for key, n in found.items() if n > 0]


def span(first: int, last: int) -> str:
    """Return ``frame 3`` or ``frames 3 to 9``."""
    return f"frame {first}" if first == last else f"frames {first} to {last}"


def event_words(event: dict[str, Any]) -> str:
    """Return names and values of what belongs to an event, but for its kind, frame, time and submap."""

    def shown(value: object) -> str:
        if isinstance(value, list):
            return "[" + ", ".join(map(shown, value)) + "]"
        if isinstance(value, dict):
            return "(" + ", ".join(f"{k} {shown(v)}" for k, v in value.items()) + ")"
        return number(value, 4) if isinstance(value, float) else str(value)

    return ", ".join(f"{k} {shown(v)}" for k, v in event.items() if k not in _WHERE and v is not None)
