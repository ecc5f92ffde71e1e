"""Specification of a bench, as strict YAML."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import Any, Self

from pydantic import Field, model_validator

from dualslam.core.config import strict_yaml
from dualslam.core.config.corruption import Cause, Corruption, CorruptionKind
from dualslam.core.config.files import model_from_dict
from dualslam.core.config.problems import StrictModel
from dualslam.core.errors import ConfigError

_NAME = r"^[A-Za-z0-9][A-Za-z0-9._+-]*$"


class Half(StrEnum):
    """Which half of all trials a bench runs: what is chosen on one is reported on the other.

    The halves share no seed, no start frame and no place of a corruption, save where a spec fixes these.
    """

    DEVELOPMENT = "development"  # to look at, and to choose thresholds and settings on
    REPORTING = "reporting"  # to publish; nothing may be chosen on it


class SequenceSpec(StrictModel):
    """A sequence, and which part of it a trial takes."""

    name: str = Field(pattern=_NAME)
    """Its name in the tables, and of its folder of trials."""
    source: str
    """As for `dualslam run`; a path is sought in the folder of `--data`. ``{seed}`` becomes a seed of the trial's own,
    below 20000 in the development half and above it in the reporting half."""
    group: str = "all"
    """The data set that it belongs to: failures are counted by group too."""
    frames: int | None = Field(None, ge=10)
    """Frames of the source that a trial spans (at stride 1); null: to the end."""
    start: tuple[int, int] | None = None
    """Trials start between these frames; null: anywhere that leaves room for `frames`, or at 0 where it is null."""
    stride: int = Field(1, ge=1)
    """One frame of so many is read."""
    returns_to_start: bool = False
    """Whether the camera ends where it began, so that the end-point error says something."""
    camera: str | None = None
    """Calibration file instead of the source's own, sought as `source` is."""
    split: bool = False
    """Whether development trials lie within the first half of the frames, and reporting trials within the second."""
    half: Half | None = None
    """The only half that runs it; null: both. For a recording that is too short to split."""
    repeats_m: float | None = Field(None, gt=0)
    """Period of a world that repeats: a part that is off by half of it is joined falsely."""
    truth_breaks: tuple[tuple[int, int], ...] = ()
    """First and last frames of the source where the truth is known to be wrong. There no stretch counts as broken, and
    no join as false."""

    @model_validator(mode="after")
    def _check_start(self) -> Self:
        if self.start is not None and not 0 <= self.start[0] <= self.start[1]:
            raise ValueError(f"start of {self.name} is {list(self.start)}; it must be [first, last], in order")
        return self


class VariantSpec(StrictModel):
    """A way to run: a name and what it sets in the configuration."""

    name: str = Field(pattern=_NAME)
    """Its name in the tables."""
    set: dict[str, Any] = Field(default_factory=dict)
    """Config fields by their path, such as {recovery.enabled: false}, over those of the bench."""


Range = tuple[float, float]


class PlacedCorruption(StrictModel):
    """A corruption whose place in the clip differs from trial to trial."""

    kind: CorruptionKind
    """As in the config's `corruptions`."""
    strength: float | Range | None = None
    """As there; null: the kind's default; two numbers: trials are spread evenly between them."""
    frames: int | None = Field(None, ge=1)
    """How many frames of the source it lasts."""
    seconds: float | Range | None = None
    """The same in seconds of the source, or trials are spread between two. Without either, it lasts to the end."""
    at: tuple[float, float] = (0.35, 0.65)
    """Where it begins: between these shares of the clip. [0, 0] is its first frame."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.frames is not None and self.seconds is not None:
            raise ValueError(f"{self.kind} lasts both frames and seconds; give one of them")
        if not 0 <= self.at[0] <= self.at[1] <= 1:
            raise ValueError(f"at of {self.kind} is {list(self.at)}; it must be two shares of the clip, in order")
        for name in ("strength", "seconds"):
            value = getattr(self, name)
            low, high = value if isinstance(value, tuple) else (value, value)
            if low is not None and (low > high or (name == "seconds" and low <= 0)):
                raise ValueError(f"{name} of {self.kind} is {value}; it must be positive, and two numbers in order")
        try:
            for share in (0.0, 1.0):
                self.placed(0, 1.0, 0, share)
        except ConfigError as error:  # a strength that is out of bounds is an error of the spec, at its place there
            raise ValueError(str(error).removeprefix(f"{Corruption.__name__}: ")) from error
        return self

    @property
    def dose_unit(self) -> str:
        """The field that varies from trial to trial, ``strength`` or ``seconds``; empty if both are fixed."""
        return next((name for name in ("strength", "seconds") if isinstance(getattr(self, name), tuple)), "")

    def dose(self, share: float) -> float | None:
        """Return the strength or the seconds at a share (0 to 1) of their range; None where both are fixed."""
        return _within(getattr(self, self.dose_unit), share) if self.dose_unit else None

    def placed(self, start: int, rate_hz: float, seed: int, share: float = 0.0) -> Corruption:
        """Return it at a frame of a source, and at a share of the range of its strength or seconds."""
        length, seconds = self.frames, _within(self.seconds, share)
        if seconds is not None:
            length = max(1, round(seconds * rate_hz))
        strength = _within(self.strength, share)
        return Corruption(kind=self.kind, start=start, length=length, strength=strength, seed=seed)


def _within(value: float | Range | None, share: float) -> float | None:
    return value[0] + share * (value[1] - value[0]) if isinstance(value, tuple) else value


class ConditionSpec(StrictModel):
    """Disturbance of the sequence in a trial."""

    name: str = Field(pattern=_NAME)
    """Its name in the tables."""
    corruptions: tuple[PlacedCorruption, ...] = ()
    """None: the sequence as it is."""
    sequences: tuple[str, ...] | None = None
    """The sequences that it is tried on, by name or by group; null: all."""
    part: str = Field("all", pattern=_NAME)
    """The part of the bench that it belongs to, for ``--part`` and the tables."""
    trials: int | None = Field(None, ge=1)
    """Of each sequence; null: those of the bench."""

    def is_for(self, sequence: SequenceSpec) -> bool:
        """Return whether it is tried on a sequence."""
        return self.sequences is None or not {sequence.name, sequence.group}.isdisjoint(self.sequences)

    @property
    def dosed(self) -> PlacedCorruption | None:
        """The corruption whose strength or length differs from trial to trial, if there is one."""
        return next((c for c in self.corruptions if c.dose_unit), None)

    @property
    def cause(self) -> Cause:
        """Internal where any corruption is, else image, or natural without any."""
        causes = {c.placed(0, 1.0, 0).cause for c in self.corruptions}
        return max(causes, key=list(Cause).index, default=Cause.NATURAL)


class Thresholds(StrictModel):
    """When a trial has failed."""

    min_coverage: float = Field(0.95, gt=0, le=1)
    """Share of the frames from the first initialisation on that must be in the main map."""
    max_ate: float = Field(0.05, gt=0)
    """Largest RMS trajectory error, of the length of the path."""
    max_link_scale: float = Field(0.05, gt=0)
    """A link is wrong beyond this relative error of scale,"""
    max_link_rotation_deg: float = Field(3.0, gt=0)
    """or beyond this error of rotation,"""
    max_link_position: float = Field(0.05, gt=0)
    """or beyond this error of position, of the path that it links."""


class RightRun(StrictModel):
    """When a run is right: it poses what can be posed, and nothing of its map is false."""

    min_coverage: float = Field(0.95, gt=0, le=1)
    """Share of the undisturbed frames from the first initialisation on that must be in the main map."""
    max_ate: float = Field(0.02, gt=0)
    """Largest RMS trajectory error, of the length of the path."""
    max_broken: int = Field(0, ge=0)
    """Stretches that may be broken, save those in which the truth jumps."""


class BenchSpec(StrictModel):
    """A bench: every sequence in every condition with every variant, so many trials each."""

    name: str = Field(pattern=_NAME)
    """Name of the bench."""
    sequences: tuple[SequenceSpec, ...] = Field(min_length=1)
    """Sequences of the bench."""
    variants: tuple[VariantSpec, ...] = Field(min_length=1)
    """Variants to compare. All run the same trials."""
    reference: str = ""
    """The variant that failures are reduced against; empty: the first."""
    conditions: tuple[ConditionSpec, ...] = Field((ConditionSpec(name="natural"),), min_length=1)
    """Disturbances of the sequences."""
    trials: int = Field(10, ge=1)
    """Of each sequence and condition. They differ in start frame, in where corruptions strike, and in seeds."""
    seed: int = Field(0, ge=0)
    """Of where trials start, where corruptions lie, and of each trial's own seeds."""
    half: Half = Half.REPORTING
    """Development trials are for choosing settings on, reporting trials for the tables that are published."""
    set: dict[str, Any] = Field(default_factory=dict)
    """Config fields of all variants."""
    thresholds: Thresholds = Thresholds()
    """When a trial has failed."""
    right: RightRun | None = None
    """When a run is right; with it, the bench says how often the verdict of a run is true."""
    timeout_s: float | None = Field(None, gt=0)
    """A trial that takes longer (wall time) is ended after its frame, and has failed."""

    @model_validator(mode="after")
    def _check_names(self) -> Self:
        for what in ("sequences", "variants", "conditions"):
            twice = [name for name, n in Counter(item.name for item in getattr(self, what)).items() if n > 1]
            if twice:
                raise ValueError(f"two {what} are called {twice[0]}; names tell them apart")
        if self.reference and self.reference not in self.variant_names:
            raise ValueError(f"reference is {self.reference}; the variants are {', '.join(self.variant_names)}")
        known = {name for sequence in self.sequences for name in (sequence.name, sequence.group)}
        for condition in self.conditions:
            for name in condition.sequences or ():
                if name not in known:
                    raise ValueError(f"condition {condition.name} is for {name}, which is none of the sequences")
        return self

    @property
    def variant_names(self) -> tuple[str, ...]:
        """Names of the variants, in order."""
        return tuple(variant.name for variant in self.variants)

    @property
    def reference_name(self) -> str:
        """The variant that others are compared with."""
        return self.reference or self.variant_names[0]

    def only(self, names: Iterable[str]) -> BenchSpec:
        """Return the bench on these sequences alone (on all, where none is named).

        Raises
        ------
        ConfigError
        """
        chosen = set(names)
        unknown = chosen - {sequence.name for sequence in self.sequences}
        if unknown:
            known = ", ".join(sequence.name for sequence in self.sequences)
            raise ConfigError(f"bench {self.name} has no sequence {sorted(unknown)[0]}; it has {known}")
        if not chosen:
            return self
        kept = tuple(s for s in self.sequences if s.name in chosen)
        conditions = tuple(
            c if c.sequences is None else c.model_copy(update={"sequences": tuple(s.name for s in kept if c.is_for(s))})
            for c in self.conditions
            if any(map(c.is_for, kept))
        )
        return self.model_copy(update={"sequences": kept, "conditions": conditions})

    def parts(self, names: Iterable[str]) -> BenchSpec:
        """Return the bench with the conditions of these parts alone (with all, where none is named).

        Raises
        ------
        ConfigError
        """
        chosen, known = set(names), list(dict.fromkeys(c.part for c in self.conditions))
        if unknown := chosen - set(known):
            raise ConfigError(f"bench {self.name} has no part {sorted(unknown)[0]}; it has {', '.join(known)}")
        kept = tuple(c for c in self.conditions if not chosen or c.part in chosen)
        return self.model_copy(update={"conditions": kept})

    def with_trials(self, trials: int | None, half: str | None) -> BenchSpec:
        """Return the bench with so many trials and of this half, where they are given."""
        wanted: dict[str, Any] = {} if trials is None else {"trials": trials}
        return self.model_copy(update=wanted if half is None else wanted | {"half": Half(half)})


def load_spec(path: str | Path) -> BenchSpec:
    """Read a bench.

    Raises
    ------
    ConfigError
        One sentence: where, which field, what is wrong, and the nearest known field.
    """
    data = strict_yaml.read(Path(path), "the bench")
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: a bench is a mapping with name, sequences and variants")
    return model_from_dict(BenchSpec, data, str(path))
