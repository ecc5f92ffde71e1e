"""Deliberate failures as config values: image corruptions and faults inside the system."""

from __future__ import annotations

from enum import StrEnum
from typing import Self

from pydantic import Field, model_validator

from dualslam.core.config.problems import StrictModel


class CorruptionKind(StrEnum):
    """Kinds of corruption: name, default, lowest and highest strength; in brackets what it means."""

    default: float
    lowest: float
    highest: float

    def __new__(cls, name: str, default: float, lowest: float, highest: float) -> Self:
        """Make a kind whose value is its name."""
        kind = str.__new__(cls, name)
        kind._value_ = name
        kind.default, kind.lowest, kind.highest = default, lowest, highest
        return kind

    WIPE = "wipe", 1.0, 0.0, 1.0  # fog, or a blank wall before the lens: texture fades to flat shade (fraction)
    OCCLUSION = "occlusion", 0.4, 0.0, 1.0  # something textured moves through the image (fraction that it hides)
    BLUR = "blur", 5.0, 0.0, 100.0  # out of focus (standard deviation in pixels of a 640 pixels wide image)
    MOTION_BLUR = "motion_blur", 30.0, 0.0, 400.0  # the camera shakes (pixels of a 640 pixels wide image)
    BLACKOUT = "blackout", 1.0, 0.0, 1.0  # the lens is covered (fraction of the light that is lost)
    EXPOSURE = "exposure", 2.5, -8.0, 8.0  # too bright or too dark (stops, positive is brighter)
    NOISE = "noise", 25.0, 0.0, 200.0  # sensor noise (standard deviation, grey levels)
    FREEZE = "freeze", 1.0, 0.0, 1.0  # the camera delivers the last image again and again
    DROP = "drop", 1.0, 0.0, 1.0  # the frames do not arrive
    STRIDE = "stride", 3.0, 2.0, 1000.0  # one frame of so many arrives (their number)
    FEW_FEATURES = "few_features", 0.8, 0.0, 1.0  # the detector finds little (fraction of the features that is lost)
    WRONG_POSE = "wrong_pose", 15.0, 0.0, 180.0  # a wrong keyframe (degrees; moved by as much of the depth)
    KILL_WORKER = "kill_worker", 1.0, 0.0, 1.0  # the first recovery that starts in the frames loses its process
    SOLVER_ERROR = "solver_error", 1.0, 0.0, 1.0  # the live graph fails at the first keyframe of the frames
    SHUTTER = "shutter", 1.0, 0.0, 4.0  # rendered worlds: the shutter stays open (fraction of the time between frames)
    ROTATION = "rotation", 60.0, -180.0, 180.0  # rendered worlds: swung aside and back (degrees, right is +)
    FOCAL = "focal", 0.8, 0.1, 10.0  # the calibration's focal length is wrong (factor)
    RESOLUTION = "resolution", 0.5, 0.1, 10.0  # the calibration is that of images of another size (factor)
    NO_DISTORTION = "no_distortion", 1.0, 0.0, 1.0  # the calibration lacks the lens distortion
    CLOCK_UNIT = "clock_unit", 1000.0, 1e-9, 1e9  # times are in another unit than seconds (units a second)
    CLOCK_JITTER = "clock_jitter", 0.5, 0.0, 0.99  # times scatter evenly (fraction of the time between frames)
    CLOCK_REPEAT = "clock_repeat", 2.0, 2.0, 1000.0  # neighbouring frames share the time of their first (their number)
    CAB = "cab", 0.28, 0.01, 0.8  # a driver's cab about the windscreen stands still in the image (share of the image)
    BONNET = "bonnet", 0.15, 0.01, 0.4  # a car's bonnet stands still at the lower edge (share of the image)
    BARS = "bars", 0.6, 0.01, 0.9  # black bars left and right, as about an upright film (share of the image)
    LOGO = "logo", 0.02, 0.001, 0.2  # a logo in the upper right corner (share of the image)
    CLOCK = "clock", 0.01, 0.001, 0.1  # a clock in the lower left corner, whose digits change (share of the image)


class Cause(StrEnum):
    """Origin of a disturbance. Results are grouped by it."""

    NATURAL = "natural"
    """Nothing was added: what the sequence itself does."""
    IMAGE = "image"
    INPUT = "input"
    """Wrong data beside the images: the calibration or the clock."""
    INTERNAL = "internal"


INTERNAL_KINDS = frozenset({CorruptionKind.WRONG_POSE, CorruptionKind.SOLVER_ERROR, CorruptionKind.KILL_WORKER})

CAMERA_KINDS = frozenset({CorruptionKind.FOCAL, CorruptionKind.RESOLUTION, CorruptionKind.NO_DISTORTION})

CLOCK_KINDS = frozenset({CorruptionKind.CLOCK_UNIT, CorruptionKind.CLOCK_JITTER, CorruptionKind.CLOCK_REPEAT})

RENDERED_KINDS = frozenset({CorruptionKind.SHUTTER, CorruptionKind.ROTATION})


class Corruption(StrictModel):
    """One disturbance of the frames ``start <= index < start + length``, indices counted in the source."""

    kind: CorruptionKind
    """One of these, by what it disturbs.

    Image: wipe, occlusion, blur, motion_blur, blackout, exposure, noise, freeze. Frames: drop, stride.
    Internals: few_features, wrong_pose, solver_error, kill_worker. Camera: focal, resolution, no_distortion.
    Times: clock_unit, clock_jitter, clock_repeat. What stands still: cab, bonnet, bars, logo, clock.
    A rendered world's script also has shutter and rotation."""
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
        low, high = self.kind.lowest, self.kind.highest
        if not low <= self.level <= high:
            raise ValueError(f"strength of {self.kind} is {self.level:g}; it must lie between {low:g} and {high:g}")
        if self.kind is CorruptionKind.ROTATION and self.length is None:
            raise ValueError("rotation needs a length: the camera is swung aside and back in it")
        if self.kind in CAMERA_KINDS and (self.start, self.length) != (0, None):
            raise ValueError(f"{self.kind} is of the whole run; leave out start and length")
        return self

    @property
    def level(self) -> float:
        """The strength, or the kind's default."""
        return self.kind.default if self.strength is None else self.strength

    @property
    def cause(self) -> Cause:
        """Whether images, what comes with them, or the system's inside are disturbed."""
        if self.kind in INTERNAL_KINDS:
            return Cause.INTERNAL
        return Cause.INPUT if self.kind in CAMERA_KINDS | CLOCK_KINDS else Cause.IMAGE

    def covers(self, index: int) -> bool:
        """Return whether frame `index` is disturbed."""
        return self.start <= index and (self.length is None or index < self.start + self.length)
