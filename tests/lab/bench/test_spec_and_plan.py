"""What a bench says, and the trials that are made of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dualslam.core.config.corruption import Cause
from dualslam.core.errors import ConfigError
from dualslam.lab.bench.plan import Trial, plan_trials
from dualslam.lab.bench.spec import BenchSpec, Half, load_spec
from tests.lab.bench.fakes import SPEC, describe

MINIMAL = """
name: small
sequences: [{name: street, source: "synthetic:street,frames=100", frames: 50}]
variants: [{name: base, set: {recovery.enabled: false}}, {name: Dual}]
"""


def load(tmp_path: Path, text: str) -> BenchSpec:
    (tmp_path / "bench.yaml").write_text(text)
    return load_spec(tmp_path / "bench.yaml")


def test_what_is_not_said_has_a_default(tmp_path: Path) -> None:
    spec = load(tmp_path, MINIMAL)
    assert (spec.reference_name, spec.trials, spec.conditions[0].name) == ("base", 10, "natural")
    assert spec.thresholds.min_coverage == 0.95


@pytest.mark.parametrize(
    ("added", "said"),
    [
        ("trails: 3", "unknown field trails; did you mean trials?"),
        ("trials: 0", "trials must be greater than or equal to 1, not 0"),
        ("reference: Dual+", "reference is Dual+; the variants are base, Dual"),
        ("thresholds: {max_ate: big}", "thresholds.max_ate must be a number"),
        ("conditions: [{name: x, corruptions: [{kind: blackout, frames: 2, seconds: 1.0}]}]", "give one of them"),
        ("conditions: [{name: x, corruptions: [{kind: blur, strength: 900.0}]}]", "strength of blur is 900"),
        ("conditions: [{name: x, corruptions: [{kind: blur, at: [0.9, 0.1]}]}]", "two shares of the clip"),
        ("conditions: [{name: a b}]", "conditions[0].name"),
        ("conditions: [{name: x}, {name: x}]", "two conditions are called x"),
        ("conditions: [{name: x, sequences: [road]}]", "condition x is for road, which is none of the sequences"),
    ],
)
def test_a_mistake_is_named(tmp_path: Path, added: str, said: str) -> None:
    with pytest.raises(ConfigError) as error:
        load(tmp_path, MINIMAL + added)
    assert said in str(error.value)
    assert "bench.yaml" in str(error.value)


def test_only_some_sequences() -> None:
    only = SPEC.only(["b"])
    assert [s.name for s in only.sequences] == ["b"]
    assert [c.name for c in only.conditions] == ["natural", "blackout"]
    assert SPEC.only([]) is SPEC
    with pytest.raises(ConfigError, match="has no sequence c; it has a, b"):
        SPEC.only(["c"])


def test_causes() -> None:
    assert [c.cause for c in SPEC.conditions] == [Cause.NATURAL, Cause.IMAGE, Cause.INTERNAL]


def of(trials: list[Trial], sequence: str, condition: str, variant: str = "base") -> list[Trial]:
    return [t for t in trials if (t.sequence, t.condition, t.variant) == (sequence, condition, variant)]


def test_all_variants_run_the_same_trials() -> None:
    trials = plan_trials(SPEC, describe)
    assert len(trials) == 2 * 3 * (3 + 2)
    assert len({t.key for t in trials}) == len({t.fingerprint for t in trials}) == len(trials)
    for base, dual in zip(of(trials, "a", "blackout"), of(trials, "a", "blackout", "Dual"), strict=True):
        assert (base.start, base.max_frames) == (dual.start, dual.max_frames)
        assert base.config["corruptions"] == dual.config["corruptions"]
        assert base.config["seed"] == dual.config["seed"]
        assert base.config["recovery"]["enabled"] is False
        assert dual.config["recovery"]["enabled"] is True


def test_trials_differ_in_start_place_and_seed() -> None:
    many = SPEC.model_copy(update={"trials": 20})
    trials = of(plan_trials(many, describe), "a", "blackout")
    starts = np.array([t.start for t in trials])
    places = np.array([t.config["corruptions"][0]["start"] for t in trials]) - starts
    assert len(set(starts.tolist())) == len({t.config["seed"] for t in trials}) == 20
    assert len(set(places.tolist())) > 8
    # Spread over all that there is: 1000 frames and clips of 100, from 35 % to 65 % of the clip.
    assert np.diff(np.sort(np.r_[0, starts, 900])).max() < 0.15 * 900
    assert np.all((places >= 34) & (places <= 65))
    assert np.ptp(places) > 25
    assert abs(np.corrcoef(starts, places)[0, 1]) < 0.4
    assert {t.config["corruptions"][0]["length"] for t in trials} == {10}  # half a second at 20 Hz


def test_another_sequence_changes_no_other_trial() -> None:
    fewer = plan_trials(SPEC.only(["b"]), describe)
    prints = {t.key: t.fingerprint for t in plan_trials(SPEC, describe)}
    assert all(prints[t.key] == t.fingerprint for t in fewer)
    assert prints != {t.key: t.fingerprint for t in plan_trials(SPEC.model_copy(update={"seed": 1}), describe)}


def test_more_trials_leave_those_that_there_are() -> None:
    prints = {t.fingerprint for t in plan_trials(SPEC.model_copy(update={"trials": 8}), describe)}
    assert all(t.fingerprint in prints for t in plan_trials(SPEC, describe))


def test_the_halves_share_no_seed_start_or_place() -> None:
    many = SPEC.model_copy(update={"trials": 20})
    chosen_on, reported_on = (of(plan_trials(many.with_trials(None, half), describe), "a", "blackout") for half in Half)
    for value in (
        lambda t: t.config["seed"],
        lambda t: t.config["corruptions"][0]["seed"],
        lambda t: (t.start, t.config["corruptions"][0]["start"]),
    ):
        assert not {value(t) for t in chosen_on} & {value(t) for t in reported_on}
    assert not {t.fingerprint for t in chosen_on} & {t.fingerprint for t in reported_on}


def test_the_command_line_decides_on_trials_and_half() -> None:
    asked = SPEC.with_trials(7, "development")
    assert (asked.trials, asked.half) == (7, Half.DEVELOPMENT)
    assert SPEC.with_trials(None, None) == SPEC
    assert SPEC.half is Half.REPORTING


def test_a_whole_sequence_is_run_to_its_end() -> None:
    whole = SPEC.sequences[0].model_copy(update={"frames": None, "start": (0, 90), "stride": 2})
    trials = plan_trials(SPEC.model_copy(update={"sequences": (whole,)}), describe)
    assert {t.max_frames for t in trials} == {0}
    assert {t.stride for t in trials} == {2}
    assert all(0 <= t.start <= 90 for t in trials)


def test_what_does_not_fit_is_named() -> None:
    long = SPEC.sequences[0].model_copy(update={"frames": 2000})
    with pytest.raises(ConfigError, match="spans 2000 frames, but a has 1000"):
        plan_trials(SPEC.model_copy(update={"sequences": (long,)}), describe)
    late = SPEC.sequences[0].model_copy(update={"start": (0, 950)})
    with pytest.raises(ConfigError, match="start at 900 at the latest"):
        plan_trials(SPEC.model_copy(update={"sequences": (late,)}), describe)
    wrong = SPEC.variants[1].model_copy(update={"set": {"recovery.enable": True}})
    with pytest.raises(ConfigError, match=r"variant Dual, recovery\.enable: unknown field"):
        plan_trials(SPEC.model_copy(update={"variants": (SPEC.variants[0], wrong)}), describe)


SPLIT = """
name: split
sequences:
  - {name: film, source: film, group: steady, frames: 300, split: true}
  - {name: world, source: "synthetic:room,frames=90,seed={seed}", group: steady}
  - {name: short, source: short, half: development}
variants: [{name: Dual}]
conditions:
  - {name: natural, part: plain}
  - {name: dark, part: lit, trials: 12, sequences: [steady], corruptions: [{kind: blackout, seconds: [0.2, 3.0]}]}
  - {name: lens, part: input, sequences: [film], corruptions: [{kind: focal, strength: 0.8}]}
trials: 2
"""


def test_halves_share_no_frame_and_no_world(tmp_path: Path) -> None:
    spec = load(tmp_path, SPLIT)
    halves = [plan_trials(spec.with_trials(None, half), describe) for half in Half]
    films = [[t.start for t in of(trials, "film", "dark", "Dual")] for trials in halves]
    assert 0 <= min(films[0]) <= max(films[0]) <= 200
    assert 500 <= min(films[1]) <= max(films[1]) <= 700
    worlds = [[t.source for t in of(trials, "world", "dark", "Dual")] for trials in halves]
    assert worlds[0] == [f"synthetic:room,frames=90,seed={1000 + n}" for n in range(12)]
    assert worlds[1] == [f"synthetic:room,frames=90,seed={20_000 + n}" for n in range(12)]
    assert [len(of(trials, "short", "natural", "Dual")) for trials in halves] == [2, 0]
    assert len(halves[0]) == 3 * 2 + 2 * 12 + 2


def test_doses_are_spread_over_their_range(tmp_path: Path) -> None:
    trials = of(plan_trials(load(tmp_path, SPLIT), describe), "film", "dark", "Dual")
    doses = np.array([t.dose for t in trials], float)
    lengths = [t.config["corruptions"][0]["length"] for t in trials]
    assert lengths == [round(20.0 * dose) for dose in doses.tolist()]
    assert np.diff(np.sort(np.r_[0.2, doses, 3.0])).max() < 0.25 * 2.8
    (wrong, _) = of(plan_trials(load(tmp_path, SPLIT), describe), "film", "lens", "Dual")
    assert (wrong.dose, wrong.config["corruptions"][0]["start"]) == (None, 0)


def test_only_one_of_the_sequences_of_a_condition(tmp_path: Path) -> None:
    only = load(tmp_path, SPLIT).only(["world"])
    assert {t.key for t in plan_trials(only, describe)} == {
        *(f"world/natural/Dual/{n:02d}" for n in range(2)),
        *(f"world/dark/Dual/{n:02d}" for n in range(12)),
    }


def test_only_some_parts(tmp_path: Path) -> None:
    spec = load(tmp_path, SPLIT)
    assert [c.name for c in spec.parts(["lit", "input"]).conditions] == ["dark", "lens"]
    assert spec.parts([]).conditions == spec.conditions
    with pytest.raises(ConfigError, match="has no part dark; it has plain, lit, input"):
        spec.parts(["dark"])
