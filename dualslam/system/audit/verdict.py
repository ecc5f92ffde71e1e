"""The verdict on a run: how far to trust it, why, and what to do."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np

from dualslam.core.noise_model import ROBUST_N, STRETCH_S, TINY
from dualslam.core.types import FloatArray

MAX_REASONS = 3


class Level(StrEnum):
    """How far to trust a run."""

    GOOD = "good"
    """A reason of this level is a remark: it does not speak against the trajectory."""
    USABLE = "usable"
    """The posed frames can be used; something is missing, or less sure than usual."""
    DOUBTFUL = "doubtful"
    """Part of what is posed is probably wrong."""


class ReasonCode(StrEnum):
    """Reasons against a run, the gravest first."""

    NO_MAP = "no_map"
    JUMP = "jump"
    PHOTOMETRIC = "photometric"
    STILL = "still"
    CAMERA = "camera"
    ZOOM = "zoom"
    SCALE = "scale"
    REPLACED = "replaced"
    CRASHED = "crashed"
    UNPOSED = "unposed"
    UNJOINED = "unjoined"
    DROPPED = "dropped"
    CLOCK = "clock"
    FOCAL = "focal"
    MEASUREMENTS = "measurements"


@dataclass(frozen=True, slots=True)
class Reason:
    """One reason of a verdict."""

    code: ReasonCode
    level: Level  # the best level that a run with this reason can have
    text: str  # what was found and what to do, in plain words
    # The frames that it is about, by their index in the source.
    first_frame: int
    last_frame: int


@dataclass(frozen=True, slots=True)
class Verdict:
    """How far to trust a run."""

    level: Level
    reasons: tuple[Reason, ...] = ()  # the gravest first, at most three; of a good run only remarks
    scores: dict[str, float] = field(default_factory=dict, compare=False)
    """By the reasons' codes: how strongly the run speaks for each, given or not. The higher, the worse."""

    @classmethod
    def of(cls, reasons: Iterable[Reason], scores: dict[str, float] | None = None) -> Verdict:
        """Return the verdict that some reasons lead to."""
        grades, codes = list(Level), list(ReasonCode)
        ordered = sorted(reasons, key=lambda r: (-grades.index(r.level), codes.index(r.code), r.first_frame))
        return cls(ordered[0].level if ordered else Level.GOOD, tuple(ordered[:MAX_REASONS]), scores or {})

    def as_dict(self) -> dict[str, Any]:
        """Return what ``summary.json`` holds."""
        reasons = [
            {"code": str(r.code), "text": r.text, "first_frame": r.first_frame, "last_frame": r.last_frame}
            for r in self.reasons
        ]
        return {"level": str(self.level), "reasons": reasons, "scores": self.scores}

    def doubt_about(self, frame: int) -> str:
        """Return the code of the gravest reason that is about a frame; empty where none is. Remarks are no doubt."""
        doubts = (r for r in self.reasons if r.level is not Level.GOOD)
        return next((str(r.code) for r in doubts if r.first_frame <= frame <= r.last_frame), "")

    def __str__(self) -> str:
        """Return the verdict in one line."""
        return f"{self.level}: {' '.join(r.text for r in self.reasons)}" if self.reasons else str(self.level)


LEAST_OF_MEDIAN = 0.5
"""Share of the median speed, or interval, that is expected at least: a camera at rest starts to move, and timestamps
repeat or come late in turns."""
STRETCH_FRAMES = 20
"""Of a stretch, at least: 10 a second. Between rarer ones a camera may truly change its speed so much, and timestamps
may be in another unit."""


def measure_jumps(times_s: FloatArray, centres: FloatArray) -> FloatArray:
    """Compare each step of a trajectory with the median of those about it.

    - `times_s` (N,): ascending; some may repeat.
    - `centres` (N, 3): of the camera.

    Returns (N - 1,): excess of each step's speed, as a share of the way of `STRETCH_S` at the speed about it.
    """
    interval_s = np.diff(times_s)
    usual_s = float(np.median(interval_s[interval_s > 0])) if (interval_s > 0).any() else 1e-9
    interval_s = np.maximum(interval_s, LEAST_OF_MEDIAN * usual_s)
    speed = np.linalg.norm(np.diff(centres, axis=0), axis=1) / interval_s
    if len(speed) <= 2 * ROBUST_N:
        return np.zeros(len(speed))
    padded = np.concatenate([np.full(ROBUST_N, np.nan), speed, np.full(ROBUST_N, np.nan)])
    window = np.lib.stride_tricks.sliding_window_view(padded, 2 * ROBUST_N + 1)
    about = np.nanmedian(np.delete(window, ROBUST_N, axis=1), axis=1)
    expected = np.maximum(about, LEAST_OF_MEDIAN * float(np.median(speed)))
    return np.asarray((speed / np.maximum(expected, TINY) - 1.0) / max(STRETCH_S / usual_s, STRETCH_FRAMES))
