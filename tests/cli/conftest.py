from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from dualslam.sources import make_world
from dualslam.synthetic import SyntheticSequence, render_to_folder
from tests.cli.fakes import builder

N_FRAMES = 24


@pytest.fixture(scope="session")
def world() -> SyntheticSequence:
    return make_world("street", N_FRAMES, 1)


@pytest.fixture(scope="session")
def folder(world: SyntheticSequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_to_folder(world, tmp_path_factory.mktemp("sequence") / "street")


@pytest.fixture
def fake(world: SyntheticSequence, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Put a fake system in the place of the real one, with the options of `FakeSystem`."""

    def install(**options: object) -> None:
        truth = dict(enumerate(world.ground_truth_T_world_cam))
        monkeypatch.setattr("dualslam.session.build_system", builder(truth, **options))

    install()
    return install
