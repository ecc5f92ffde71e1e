from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from dualslam.core.estimates import FrontendChoice
from dualslam.core.resources import LIMITS
from dualslam.lab.synthetic import SyntheticSequence, render_to_folder
from dualslam.run.sources import make_world
from tests.cli.fakes import builder

N_FRAMES = 24


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The command sets up logging and the environment of its process; keep them out of the others' tests."""
    for name in (*LIMITS, "OPENCV_LOG_LEVEL", "OPENCV_FFMPEG_LOGLEVEL"):
        monkeypatch.setenv(name, os.environ.get(name, "1"))
    root = logging.getLogger()
    before = (root.handlers[:], root.level)
    yield
    root.handlers[:], root.level = before


@pytest.fixture(scope="session")
def world() -> SyntheticSequence:
    return make_world("street", N_FRAMES, 1)


@pytest.fixture(scope="session")
def folder(world: SyntheticSequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_to_folder(world, tmp_path_factory.mktemp("sequence") / "street")


@pytest.fixture
def fake(world: SyntheticSequence, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Put a fake system instead of the real one, with the options of `FakeSystem`."""

    def install(**options: object) -> None:
        truth = dict(enumerate(world.ground_truth_T_world_cam))
        monkeypatch.setattr("dualslam.run.session.build_system", builder(truth, **options))
        # No front end looks at the frames, so none need be chosen by them.
        monkeypatch.setattr("dualslam.run.before.find_frontend", lambda *_: FrontendChoice("orb", "a fake"))

    install()
    return install
