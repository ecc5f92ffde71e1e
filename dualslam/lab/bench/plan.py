"""From a bench to its trials: where each starts, where its corruption lies, which configuration it runs with.

All variants get the same trials. What is random about one depends on the bench's seed and half, the names of its
sequence and condition, and its number alone, so that another sequence or more trials leave the others as they are.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from dualslam.config.files import Override, load_config
from dualslam.config.settings import Config
from dualslam.core.errors import ConfigError
from dualslam.lab.bench.spec import BenchSpec, ConditionSpec, Half, SequenceSpec, VariantSpec

# Steps of start and place that spread any number of trials evenly over both: the golden ratio's fraction leaves the
# smallest gaps, and the square root of 2 is in no simple ratio to it.
_SPREAD = (0.6180339887498949, 0.41421356237309515)
_SALT = {Half.DEVELOPMENT: (), Half.REPORTING: (0x5245504F,)}
"""What a half adds to every seed. Trials from before there were halves are development trials."""


@dataclass(frozen=True, slots=True)
class SourceInfo:
    """What a plan needs to know of a source.

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
    info = {sequence.name: describe(sequence) for sequence in spec.sequences}
    for variant in spec.variants:
        _config(spec, variant, 0, [])  # a wrong field is told before any long work
    return [
        _trial(spec, sequence, info[sequence.name], condition, variant, number)
        for number in range(spec.trials)
        for sequence in spec.sequences
        for condition in _conditions_of(spec, sequence)
        for variant in spec.variants
    ]


def _conditions_of(spec: BenchSpec, sequence: SequenceSpec) -> Iterator[ConditionSpec]:
    return (c for c in spec.conditions if c.sequences is None or sequence.name in c.sequences)


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
    shares = np.random.default_rng([spec.seed, words, *salt]).random(2) + np.multiply(number, _SPREAD)
    first, last = _start_range(sequence, info)
    start = first + int((last - first + 1) * (shares[0] % 1))
    span = min(sequence.frames or info.n_frames, info.n_frames - start)
    seed = int(rng.integers(2**31))
    corruptions = []
    for placed in condition.corruptions:
        share = placed.at[0] + (placed.at[1] - placed.at[0]) * (shares[1] % 1)
        at = start + int(share * (span - 1))
        corruptions.append(placed.placed(at, info.rate_hz, int(rng.integers(2**31))).model_dump(mode="json"))
    return Trial(
        sequence=sequence.name,
        condition=condition.name,
        variant=variant.name,
        number=number,
        source=info.source,
        camera=info.camera,
        start=start,
        stride=sequence.stride,
        max_frames=-(-span // sequence.stride) if sequence.frames is not None else 0,
        config=_config(spec, variant, seed, corruptions).model_dump(mode="json"),
        returns_to_start=sequence.returns_to_start,
        timeout_s=spec.timeout_s,
    )


def _start_range(sequence: SequenceSpec, info: SourceInfo) -> tuple[int, int]:
    room = info.n_frames - (sequence.frames or 1)
    if room < 0:
        raise ConfigError(
            f"sequence {sequence.name}: a trial spans {sequence.frames} frames, but {info.source} has {info.n_frames}"
        )
    first, last = sequence.start or ((0, room) if sequence.frames is not None else (0, 0))
    if last > room:
        raise ConfigError(
            f"sequence {sequence.name}: a trial may start at frame {last}, but {info.source} has {info.n_frames} "
            f"and a trial spans {sequence.frames or 'what is left'}; start at {room} at the latest"
        )
    return first, last


def _config(spec: BenchSpec, variant: VariantSpec, seed: int, corruptions: list[dict[str, Any]]) -> Config:
    overrides = [Override(("seed",), seed, "seed")]
    for where, fields in ((f"bench {spec.name}", spec.set), (f"variant {variant.name}", variant.set)):
        overrides += [Override(tuple(path.split(".")), value, f"{where}, {path}") for path, value in fields.items()]
    overrides.append(Override(("corruptions",), corruptions, "corruptions"))
    return load_config(None, overrides)
