"""From a bench to its trials: where each starts, where its corruption lies, which configuration it runs with.

All variants get the same trials. Its random part depends on four things alone: the bench's seed and half, the names of
its sequence and condition, and its number. So another sequence or more trials do not change the others.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from dualslam.core.config.corruption import CAMERA_KINDS
from dualslam.core.config.files import Override, load_config
from dualslam.core.config.settings import Config
from dualslam.core.errors import ConfigError
from dualslam.lab.bench.spec import BenchSpec, ConditionSpec, Half, SequenceSpec, VariantSpec

# Steps of start, place and dose that spread any number of trials evenly over them: the golden ratio's fraction leaves
# the smallest gaps, and the square roots of 2 and 3 are in no simple ratio to it.
_SPREAD = (0.6180339887498949, 0.41421356237309515, 0.7320508075688772)
_SALT = {Half.DEVELOPMENT: (), Half.REPORTING: (0x5245504F,)}
"""Offset of each half's seeds. Trials without a half are development trials."""

_FIRST_WORLD = {Half.DEVELOPMENT: 1000, Half.REPORTING: 20_000}
"""Seed of the first trial's world, where each trial has its own."""


@dataclass(frozen=True, slots=True)
class SourceInfo:
    """Facts about a source that a plan needs.

    Attributes
    ----------
    source, camera : str
        As a trial opens them; `camera` empty for the source's own.
    n_frames : int
    rate_hz : float
        At stride 1.
    """

    source: str
    camera: str
    n_frames: int
    rate_hz: float


@dataclass(frozen=True, slots=True)
class Trial:
    """One run of a bench: plain values, so that it can be sent to another process or machine.

    Attributes
    ----------
    sequence, condition, variant : str
    number : int
        Of the trial, from 0.
    source, camera : str
    start, stride, max_frames : int
        Which frames; `max_frames` 0 for all that there are.
    config : dict
        The whole configuration.
    returns_to_start : bool
    timeout_s : float or None
    dose : float or None
        Strength or seconds of the corruption that differs from trial to trial.
    repeats_m : float or None
        Period of a world that repeats.
    truth_breaks : list of [int, int]
        First and last frames where the truth is wrong.
    """

    sequence: str
    condition: str
    variant: str
    number: int
    source: str
    camera: str
    start: int
    stride: int
    max_frames: int
    config: dict[str, Any]
    returns_to_start: bool
    timeout_s: float | None
    dose: float | None = None
    repeats_m: float | None = None
    truth_breaks: list[list[int]] = field(default_factory=list)

    @property
    def key(self) -> str:
        """Its name, and the path of its folder."""
        return f"{self.sequence}/{self.condition}/{self.variant}/{self.number:02d}"

    @property
    def fingerprint(self) -> str:
        """Changes with whatever the trial's result depends on, save the code and the images."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()[:16]


def plan_trials(spec: BenchSpec, describe: Callable[[SequenceSpec], SourceInfo]) -> list[Trial]:
    """Return all trials of a bench, so ordered that an unfinished one has a bit of everything.

    Parameters
    ----------
    spec : BenchSpec
    describe : callable
        Opens a sequence so far that its length is known; raises `InputError` where it cannot be.

    Raises
    ------
    ConfigError
        Where a variant sets what the configuration does not have, or a clip does not fit into its sequence.
    InputError
    """
    sequences = [s for s in spec.sequences if s.half in (None, spec.half)]
    info = {s.name: describe(s.model_copy(update={"source": _source(s, spec.half, 0)})) for s in sequences}
    for variant in spec.variants:
        _config(spec, variant, 0, [])  # a wrong field is reported before any long work
    return [
        _trial(spec, sequence, info[sequence.name], condition, variant, number)
        for number in range(max(spec.trials, *(c.trials or 0 for c in spec.conditions)))
        for sequence in sequences
        for condition in spec.conditions
        for variant in spec.variants
        if condition.is_for(sequence) and number < (condition.trials or spec.trials)
    ]


def _source(sequence: SequenceSpec, half: Half, number: int) -> str:
    """Return the source of a trial: where each has a world of its own, that world."""
    return sequence.source.replace("{seed}", str(_FIRST_WORLD[half] + number))


def _trial(
    spec: BenchSpec,
    sequence: SequenceSpec,
    info: SourceInfo,
    condition: ConditionSpec,
    variant: VariantSpec,
    number: int,
) -> Trial:
    words = int.from_bytes(hashlib.sha256(f"{sequence.name}\0{condition.name}".encode()).digest()[:8], "little")
    salt = _SALT[spec.half]
    rng = np.random.default_rng([spec.seed, words, number, *salt])
    shares = np.random.default_rng([spec.seed, words, *salt]).random(3) + np.multiply(number, _SPREAD)
    start_share, place_share, dose_share = (shares % 1).tolist()
    first, last = _start_range(sequence, info, spec.half)
    start = first + int((last - first + 1) * start_share)
    span = min(sequence.frames or info.n_frames, info.n_frames - start)
    seed = int(rng.integers(2**31))
    corruptions = []
    for placed in condition.corruptions:
        share = placed.at[0] + (placed.at[1] - placed.at[0]) * place_share
        at = start + int(share * (span - 1))
        at = 0 if placed.kind in CAMERA_KINDS else at
        made = placed.placed(at, info.rate_hz, int(rng.integers(2**31)), dose_share)
        corruptions.append(made.model_dump(mode="json"))
    dosed = condition.dosed
    return Trial(
        sequence=sequence.name,
        condition=condition.name,
        variant=variant.name,
        number=number,
        source=info.source.replace(_source(sequence, spec.half, 0), _source(sequence, spec.half, number)),
        camera=info.camera,
        start=start,
        stride=sequence.stride,
        max_frames=-(-span // sequence.stride) if sequence.frames is not None else 0,
        config=_config(spec, variant, seed, corruptions).model_dump(mode="json"),
        returns_to_start=sequence.returns_to_start,
        timeout_s=spec.timeout_s,
        dose=None if dosed is None else dosed.dose(dose_share),
        repeats_m=sequence.repeats_m,
        truth_breaks=[list(span) for span in sequence.truth_breaks],
    )


def _start_range(sequence: SequenceSpec, info: SourceInfo, half: Half) -> tuple[int, int]:
    room = info.n_frames - (sequence.frames or 1)
    if room < 0:
        raise ConfigError(
            f"sequence {sequence.name}: a trial spans {sequence.frames} frames, but {info.source} has {info.n_frames}"
        )
    if sequence.split:
        return _half_range(sequence, info, half)
    first, last = sequence.start or ((0, room) if sequence.frames is not None else (0, 0))
    if last > room:
        raise ConfigError(
            f"sequence {sequence.name}: a trial may start at frame {last}, but {info.source} has {info.n_frames} "
            f"and a trial spans {sequence.frames or 'what is left'}; start at {room} at the latest"
        )
    return first, last


def _half_range(sequence: SequenceSpec, info: SourceInfo, half: Half) -> tuple[int, int]:
    """Return where trials of a half may start so that all their frames are in that half of the sequence."""
    middle, span = info.n_frames // 2, sequence.frames or 0
    if not 0 < span <= middle:
        raise ConfigError(
            f"sequence {sequence.name}: half of {info.source} has {middle} frames; a trial that is to lie in it "
            f"may span as many at most, not {span or 'all'}"
        )
    return (0, middle - span) if half is Half.DEVELOPMENT else (middle, info.n_frames - span)


def _config(spec: BenchSpec, variant: VariantSpec, seed: int, corruptions: list[dict[str, Any]]) -> Config:
    overrides = [Override(("seed",), seed, "seed")]
    for where, fields in ((f"bench {spec.name}", spec.set), (f"variant {variant.name}", variant.set)):
        overrides += [Override(tuple(path.split(".")), value, f"{where}, {path}") for path, value in fields.items()]
    overrides.append(Override(("corruptions",), corruptions, "corruptions"))
    return load_config(None, overrides)
