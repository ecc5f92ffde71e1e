"""A front end of another package is held to its word, and its mistakes are told as its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dualslam.build import fault_of_frontend
from dualslam.cli import main
from dualslam.core.config.files import load_config
from dualslam.core.errors import FrontendError
from dualslam.core.types import Features, Matches
from dualslam.frontends.conformance import Subject
from dualslam.frontends.features.images import features_of
from dualslam.frontends.features.orb import OrbFrontend
from tests.cli.conftest import _own_environment  # noqa: F401 (used by every test)

IMAGE = Subject(OrbFrontend).image()[:240, :320]


class Theirs(OrbFrontend):
    """A front end that is none of ours; `spoil` is what it makes of its features."""

    spoil: Callable[[Features], Any] = staticmethod(lambda features: features)

    def extract(self, image: np.ndarray) -> Any:
        return self.spoil(super().extract(image))


class Raises(Theirs):
    def extract(self, image: np.ndarray) -> Any:
        raise RuntimeError("my own bug")


class RaisesLater(Theirs):
    def match_wide(self, a: Features, b: Features) -> Matches:
        raise RuntimeError("my other bug")


class Pair(Theirs):
    spoil = staticmethod(lambda features: (features.uv_px, None))


@pytest.mark.parametrize(
    ("spoil", "problem"),
    [
        (lambda f: (f.uv_px, None), "returned a tuple, not dualslam.core.types.Features"),
        (lambda f: None, "returned a NoneType"),
        (lambda f: replace(f, sigma_px=f.sigma_px[:-1]), r"whose sigma_px is \(\d+,\), beside \(\d+, 2\) of uv_px"),
        (lambda f: replace(f, uv_rect_px=f.uv_px[:, 0]), r"whose uv_rect_px is \(\d+,\)"),
        (lambda f: replace(f, uv_px=[[1.0, 2.0]]), "whose uv_px is a list, not a numpy array"),
        (lambda f: replace(f, octave=f.scale), "whose octave is of type float64"),
        (lambda f: replace(f, descriptors=f.descriptors.astype(object)), "whose descriptors is of type object"),
    ],
)
def test_what_is_none_of_features_is_refused(spoil: Callable[[Features], Any], problem: str) -> None:
    theirs = Theirs(100)
    assert len(features_of(theirs, IMAGE)) > 0
    theirs.spoil = spoil
    with pytest.raises(FrontendError, match=rf"^front end 'tests\.frontends\.test_asking:Theirs': .*{problem}.*check_"):
        features_of(theirs, IMAGE)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Raises", ["raised RuntimeError: my own bug (", "test_asking.py, line ", "in extract)"]),
        ("RaisesLater", ["raised RuntimeError: my other bug (", "in match_wide)", "What was found until then is in"]),
        ("Pair", ["extract returned a tuple", "What was found until then is in"]),
    ],
)
def test_the_command_says_whose_mistake_it_is(
    name: str, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = "synthetic:street,frames=8,width=320,height=240"
    out = tmp_path / "run"
    assert main(["run", source, "--out", str(out), "--frontend", f"{__name__}:{name}", "--quiet"]) == 2
    message = capsys.readouterr().err
    assert message.startswith(f"dualslam: front end '{__name__}:{name}'")
    assert "bug, please" not in message
    for each in words:
        assert each in message
    assert not list(out.glob("dualslam-bug-*"))


def test_other_mistakes_are_not_theirs() -> None:
    config = load_config(overrides=["frontend.name=elsewhere.package:Class"])
    for settings in (config, load_config()):
        with pytest.raises(AttributeError) as raised:
            features_of(None, IMAGE)  # type: ignore[arg-type]
        assert fault_of_frontend(raised.value, settings) is None
