"""Scripted disturbances: which frames are spoilt, how, and how badly. What a real camera suffers, on demand."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Any

import numpy as np

from dualslam.core.errors import ConfigError


class ScriptedEventKind(StrEnum):
    """What happens to the frames of an event; in brackets the meaning of `ScriptedEvent.strength`."""

    BLUR = "blur"  # out of focus (standard deviation in pixels of a 640 pixels wide image)
    MOTION_BLUR = "motion_blur"  # the shutter stays open (fraction of the frame interval)
    BLACKOUT = "blackout"  # the lens is covered (fraction of the light that is lost)
    EXPOSURE = "exposure"  # too bright or too dark (stops, positive is brighter)
    DROP = "drop"  # the frames do not arrive (without meaning)
    WIPE = "wipe"  # fog, or a blank wall before the lens: texture fades to flat shade (fraction)
    ROTATION = (
        "rotation"  # the camera is swung aside and back, in addition to its path (degrees, positive to the right)
    )
    NOISE = "noise"  # sensor noise (standard deviation, grey levels)


# kind: (default, lowest, highest strength)
_STRENGTHS: dict[ScriptedEventKind, tuple[float, float, float]] = {
    ScriptedEventKind.BLUR: (5.0, 0.0, 100.0),
    ScriptedEventKind.MOTION_BLUR: (1.0, 0.0, 4.0),
    ScriptedEventKind.BLACKOUT: (1.0, 0.0, 1.0),
    ScriptedEventKind.EXPOSURE: (2.5, -8.0, 8.0),
    ScriptedEventKind.DROP: (1.0, 0.0, 1.0),
    ScriptedEventKind.WIPE: (1.0, 0.0, 1.0),
    ScriptedEventKind.ROTATION: (60.0, -180.0, 180.0),
    ScriptedEventKind.NOISE: (25.0, 0.0, 200.0),
}


@dataclass(frozen=True, slots=True)
class ScriptedEvent:
    """One disturbance of the frames ``start <= index < start + length``.

    Attributes
    ----------
    kind : ScriptedEventKind
        Or its name.
    start : int
        First frame.
    length : int
        Number of frames.
    strength : float
        See `ScriptedEventKind`; a default per kind where it is left out (NaN).

    Raises
    ------
    ConfigError
        Where a value makes no sense.
    """

    kind: ScriptedEventKind
    start: int
    length: int
    strength: float = float("nan")

    def __post_init__(self) -> None:
        try:
            kind = ScriptedEventKind(self.kind)
        except ValueError:
            raise ConfigError(
                f"event kind {self.kind!r} is unknown; use one of {', '.join(ScriptedEventKind)}"
            ) from None
        object.__setattr__(self, "kind", kind)
        for name in ("start", "length"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < (name == "length"):
                lowest = 1 if name == "length" else 0
                raise ConfigError(f"event {kind}: {name} is {value!r}; it must be a whole number of at least {lowest}")
        default, low, high = _STRENGTHS[kind]
        try:
            strength = float(self.strength)
        except (TypeError, ValueError):
            raise ConfigError(f"event {kind}: strength is {self.strength!r}; it must be a number") from None
        strength = default if np.isnan(strength) else strength
        if not low <= strength <= high:
            raise ConfigError(f"event {kind}: strength is {strength:g}; it must lie between {low:g} and {high:g}")
        object.__setattr__(self, "strength", strength)

    def covers(self, index: int) -> bool:
        """Return whether frame `index` is spoilt."""
        return self.start <= index < self.start + self.length


def parse_events(items: Iterable[ScriptedEvent | Mapping[str, Any]]) -> tuple[ScriptedEvent, ...]:
    """Return events from a script, as read from YAML: a list of mappings with the fields of `ScriptedEvent`.

    Raises
    ------
    ConfigError
        Where an item is not a mapping, has unknown fields, or lacks some.
    """
    names = [f.name for f in fields(ScriptedEvent)]
    events = []
    for number, item in enumerate(items):
        if isinstance(item, ScriptedEvent):
            events.append(item)
            continue
        if not isinstance(item, Mapping):
            raise ConfigError(f"events[{number}] is {item!r}; it must be a mapping with {', '.join(names)}")
        unknown, missing = set(item) - set(names), set(names[:3]) - set(item)
        if unknown or missing:
            wrong = f"unknown fields {sorted(unknown)}" if unknown else f"no {' or '.join(sorted(missing))}"
            raise ConfigError(f"events[{number}] has {wrong}; its fields are {', '.join(names)}")
        events.append(ScriptedEvent(**item))
    return tuple(events)


@dataclass(frozen=True, slots=True)
class Disturbance:
    """All events at one frame, taken together.

    Attributes
    ----------
    blur_px : float
        Standard deviation at 640 pixels image width.
    shutter : float
        Fraction of the frame interval.
    light : float
        Fraction of the light that arrives.
    exposure_stops, wipe, noise : float
    dropped : bool
    """

    blur_px: float = 0.0
    shutter: float = 0.0
    light: float = 1.0
    exposure_stops: float = 0.0
    wipe: float = 0.0
    noise: float = 0.0
    dropped: bool = False


def disturbance(events: Iterable[ScriptedEvent], index: int) -> Disturbance:
    """Return what the events do to frame `index`; of several of a kind the strongest counts, exposures add up."""
    active = [e for e in events if e.covers(index)]

    def strongest(kind: ScriptedEventKind) -> float:
        return max((e.strength for e in active if e.kind is kind), default=0.0)

    return Disturbance(
        blur_px=strongest(ScriptedEventKind.BLUR),
        shutter=strongest(ScriptedEventKind.MOTION_BLUR),
        light=1.0 - strongest(ScriptedEventKind.BLACKOUT),
        exposure_stops=sum(e.strength for e in active if e.kind is ScriptedEventKind.EXPOSURE),
        wipe=strongest(ScriptedEventKind.WIPE),
        noise=strongest(ScriptedEventKind.NOISE),
        dropped=any(e.kind is ScriptedEventKind.DROP for e in active),
    )


def yaw_offset_rad(events: Iterable[ScriptedEvent], index: float) -> float:
    """Return how far rotation events turn the camera at the (fractional) frame `index`: out and back, smoothly."""
    total = 0.0
    for event in events:
        if event.kind is ScriptedEventKind.ROTATION:
            phase = (index - event.start + 0.5) / event.length
            if 0 < phase < 1:
                total += np.radians(event.strength) * np.sin(np.pi * phase) ** 2
    return float(total)
