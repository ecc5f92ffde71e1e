"""An event in words: what belongs to it, besides when and where it happened."""

from __future__ import annotations

from typing import Any

from dualslam.report.markup import number

_WHERE = frozenset({"event", "frame", "timestamp_s", "submap"})


def event_words(event: dict[str, Any]) -> str:
    """Return names and values of what belongs to an event, but for its kind, frame, time and submap."""

    def shown(value: object) -> str:
        if isinstance(value, list):
            return "[" + ", ".join(map(shown, value)) + "]"
        if isinstance(value, dict):
            return "(" + ", ".join(f"{k} {shown(v)}" for k, v in value.items()) + ")"
        return number(value, 4) if isinstance(value, float) else str(value)

    return ", ".join(f"{k} {shown(v)}" for k, v in event.items() if k not in _WHERE and v is not None)
