"""Scripted events of a rendered world: light, lens, shutter, and the camera's path."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from dualslam.core.config.corruption import Corruption, CorruptionKind
from dualslam.core.config.files import model_from_dict
from dualslam.core.errors import ConfigError

IN_A_WORLD = (
    CorruptionKind.WIPE,
    CorruptionKind.BLUR,
    CorruptionKind.SHUTTER,
    CorruptionKind.BLACKOUT,
    CorruptionKind.EXPOSURE,
    CorruptionKind.NOISE,
    CorruptionKind.DROP,
    CorruptionKind.ROTATION,
)
"""Kinds that a renderer can do itself; the others are put on images that are there."""


def parse_events(items: Iterable[object]) -> tuple[Corruption, ...]:
    """Return the script of a world, as read from YAML: a list of mappings with the fields of `Corruption`.

    Raises
    ------
    ConfigError
        Where an item is no mapping, has unknown fields or lacks some, or is of a kind that no renderer does.
    """
    events = []
    for number, item in enumerate(items):
        if isinstance(item, Corruption):
            event = item
        elif isinstance(item, Mapping):
            event = model_from_dict(Corruption, item, f"events[{number}]")
        else:
            fields = ", ".join(Corruption.model_fields)
            raise ConfigError(f"events[{number}] is {item!r}; it must be a mapping with {fields}")
        if event.kind not in IN_A_WORLD:
            known = ", ".join(IN_A_WORLD)
            raise ConfigError(f"events[{number}]: {event.kind} needs images that are there (--corrupt); here: {known}")
        events.append(event)
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


def disturbance(events: Iterable[Corruption], index: int) -> Disturbance:
    """Return what the events do to frame `index`; of several of a kind the strongest counts, exposures add up."""
    active = [e for e in events if e.covers(index)]

    def strongest(kind: CorruptionKind) -> float:
        return max((e.level for e in active if e.kind is kind), default=0.0)

    return Disturbance(
        blur_px=strongest(CorruptionKind.BLUR),
        shutter=strongest(CorruptionKind.SHUTTER),
        light=1.0 - strongest(CorruptionKind.BLACKOUT),
        exposure_stops=sum(e.level for e in active if e.kind is CorruptionKind.EXPOSURE),
        wipe=strongest(CorruptionKind.WIPE),
        noise=strongest(CorruptionKind.NOISE),
        dropped=any(e.kind is CorruptionKind.DROP for e in active),
    )


def yaw_offset_rad(events: Iterable[Corruption], index: float) -> float:
    """Return how far rotation events turn the camera at the (fractional) frame `index`: out and back, smoothly."""
    total = 0.0
    for event in events:
        if event.kind is CorruptionKind.ROTATION and event.length is not None:
            phase = (index - event.start + 0.5) / event.length
            if 0 < phase < 1:
                total += np.radians(event.level) * np.sin(np.pi * phase) ** 2
    return float(total)
