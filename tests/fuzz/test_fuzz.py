from __future__ import annotations

from pathlib import Path

import pytest

from tests.fuzz.campaign import KINDS, Templates, tried

N_CASES = {"sequence": 90, "camera": 90, "config": 60, "measurements": 30, "video": 10, "map": 20}
"""A few hundred, some seconds of CPU; `make fuzz` makes more."""
KEPT = {"sequence": [173], "map": [363]}
"""Seeds that have found a fault."""


@pytest.fixture(scope="module")
def templates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Templates(tmp_path_factory.mktemp("templates")).build().folder


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_sound_is_read(kind: str, templates: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.fuzz.campaign.spoil", lambda path, rng: None)
    made = [tried(kind, seed, tmp_path / str(seed), templates) for seed in range(6)]
    assert 2 not in dict(made)
    assert not [fault for _, fault in made if fault is not None]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_input_costs_a_sentence(kind: str, templates: Path, tmp_path: Path) -> None:
    made = [tried(kind, seed, tmp_path / str(seed), templates) for seed in [*range(N_CASES[kind]), *KEPT.get(kind, [])]]
    assert not [fault for _, fault in made if fault is not None]
    assert 2 in dict(made), "some of the damage is found"
