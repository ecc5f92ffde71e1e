"""What the failure lab does to a run on purpose: image corruptions and faults inside the system, as config values."""

from __future__ import annotations

from enum import StrEnum
from typing import Self

from pydantic import Field, model_validator

from dualslam.config.strict_model import StrictModel


class CorruptionKind(StrEnum):
    """What is done; in brackets the meaning of `Corruption.strength`."""

    WIPE = "wipe"  # fog, or a blank wall before the lens: texture fades to flat shade (fraction)
    OCCLUSION = "occlusion"  # something textured moves through the image (fraction of the image that it hides)
    BLUR = "blur"  # out of focus (standard deviation in pixels of a 640 pixels wide image)
    MOTION_BLUR = "motion_blur"  # the camera shakes while the shutter is open (pixels of a 640 pixels wide image)
    BLACKOUT = "blackout"  # the lens is covered (fraction of the light that is lost)
    EXPOSURE = "exposure"  # too bright or too dark (stops, positive is brighter)
    NOISE = "noise"  # sensor noise (standard deviation, grey levels)
    FREEZE = "freeze"  # the camera delivers the last image again and again (without meaning)
    DROP = "drop"  # the frames do not arrive (without meaning)
    STRIDE = "stride"  # one frame of so many arrives (their number)
    FEW_FEATURES = "few_features"  # the detector finds little (fraction of the features that is lost)
    WRONG_POSE = "wrong_pose"  # a wrong pose goes into the map as a keyframe (degrees; moved by as much of the depth)
    KILL_WORKER = "kill_worker"  # the first recovery that starts in the frames loses its process (without meaning)
    SOLVER_ERROR = "solver_error"  # the live graph fails once, at the first keyframe of the frames (without meaning)
    SHUTTER = "shutter"  # rendered worlds: the shutter stays open (fraction of the time between frames)
    ROTATION = "rotation"  # rendered worlds: the camera is swung aside and back (degrees, positive to the right)


class Cause(StrEnum):
    """Where a disturbance comes from: results are told apart by it."""

    NATURAL = "natural"
    """Nothing was added: what the sequence itself does."""
    IMAGE = "image"
    INTERNAL = "internal"


INTERNAL_KINDS = frozenset({CorruptionKind.WRONG_POSE, CorruptionKind.SOLVER_ERROR, CorruptionKind.KILL_WORKER})

RENDERED_KINDS = frozenset({CorruptionKind.SHUTTER, CorruptionKind.ROTATION})

# kind: (default, lowest, highest strength)
STRENGTHS: dict[CorruptionKind, tuple[float, float, float]] = {
    CorruptionKind.WIPE: (1.0, 0.0, 1.0),
    CorruptionKind.OCCLUSION: (0.4, 0.0, 1.0),
    CorruptionKind.BLUR: (5.0, 0.0, 100.0),
    CorruptionKind.MOTION_BLUR: (30.0, 0.0, 400.0),
    CorruptionKind.BLACKOUT: (1.0, 0.0, 1.0),
    CorruptionKind.EXPOSURE: (2.5, -8.0, 8.0),
    CorruptionKind.NOISE: (25.0, 0.0, 200.0),
    CorruptionKind.FREEZE: (1.0, 0.0, 1.0),
    CorruptionKind.DROP: (1.0, 0.0, 1.0),
    CorruptionKind.STRIDE: (3.0, 2.0, 1000.0),
    CorruptionKind.FEW_FEATURES: (0.8, 0.0, 1.0),
    CorruptionKind.WRONG_POSE: (15.0, 0.0, 180.0),
    CorruptionKind.SOLVER_ERROR: (1.0, 0.0, 1.0),
    CorruptionKind.KILL_WORKER: (1.0, 0.0, 1.0),
    CorruptionKind.SHUTTER: (1.0, 0.0, 4.0),
    CorruptionKind.ROTATION: (60.0, -180.0, 180.0),
}


class Corruption(StrictModel):
    """One disturbance of the frames ``start <= index < start + length``, indices counted in the source."""

    kind: CorruptionKind
    """wipe, occlusion, blur, motion_blur, blackout, exposure, noise, freeze, drop, stride, few_features, wrong_pose,
    solver_error or kill_worker; in the script of a rendered world also shutter and rotation."""
    start: int = Field(0, ge=0)
    """First frame, counted in the source whatever the stride."""
    length: int | None = Field(None, ge=1)
    """Number of frames; null: to the end."""
    strength: float | None = None
    """How badly, in the unit of the kind; null: the kind's default."""
    seed: int = Field(0, ge=0)
    """Of what is random about it: noise, directions, which features are lost."""

    @model_validator(mode="after")
    def _check_strength(self) -> Self:
        _, low, high = STRENGTHS[self.kind]
        if not low <= self.level <= high:
            raise ValueError(f"strength of {self.kind} is {self.level:g}; it must lie between {low:g} and {high:g}")
        if self.kind is CorruptionKind.ROTATION and self.length is None:
            raise ValueError("rotation needs a length: the camera is swung aside and back in it")
        return self

    @property
    def level(self) -> float:
        """The strength, or the kind's default."""
        return STRENGTHS[self.kind][0] if self.strength is None else self.strength

    @property
    def cause(self) -> Cause:
        """Whether images or the system's inside are disturbed."""
        return Cause.INTERNAL if self.kind in INTERNAL_KINDS else Cause.IMAGE

    def covers(self, index: int) -> bool:
        """Return whether frame `index` is disturbed."""
        return self.start <= index and (self.length is None or index < self.start + self.length)
