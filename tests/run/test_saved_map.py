"""A run on the map of an earlier one, from the source to the run folder."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from dualslam.cli import main
from dualslam.core.config.settings import Config
from dualslam.lab.synthetic import make_sequence, render_to_folder
from dualslam.report.run_data import read_run
from dualslam.run.map_camera import camera_that_fits, own_focal_px
from dualslam.run.sources import open_source
from dualslam.viewer.playback import play

SETTINGS = ["--quiet", "--set", "frontend.n_features=500"]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A folder of rendered images."""
    return str(render_to_folder(make_sequence("street", 56, 3, 320, 240), tmp_path_factory.mktemp("images") / "street"))


@pytest.fixture(scope="module")
def first(source: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a walk's first part."""
    out = tmp_path_factory.mktemp("first") / "run"
    assert main(["run", source, "--max-frames", "40", "--out", str(out), *SETTINGS]) == 0
    return out


@pytest.mark.slow
@pytest.mark.parametrize("localise", [False, True], ids=["extended", "localised"])
def test_a_run_on_a_saved_map_ends_with_all_its_pages(source: str, first: Path, localise: bool, tmp_path: Path) -> None:
    out = tmp_path / "run"
    options = ["--start", "30", "--map", str(first), *(["--localise"] if localise else [])]
    assert main(["run", source, *options, "--out", str(out), *SETTINGS]) == 0
    assert {path.name for path in out.iterdir()} >= {"map.html", "report.html", "trajectory.txt", "summary.json"}
    run, before = read_run(out), play(read_run(first)).spaces[0]
    assert run.summary["posed"] >= 10
    assert run.summary["saved_map"] == str(first)
    assert run.summary["localise"] is localise
    n_saved, n_keyframes = run.summary["saved_keyframes"], run.summary["keyframes"]
    assert 0 < n_saved <= n_keyframes
    assert (n_saved == n_keyframes) == localise
    page = (out / "report.html").read_text()
    assert f"the map saved in {first}: {n_saved} of the {n_keyframes} keyframes are of it" in page
    assert "the map saved in" not in (first / "report.html").read_text()
    assert read_run(first).summary["saved_map"] is None
    space = play(run).spaces[0]
    there = (space.keyframes.row == 0).sum()
    assert there >= len(before.keyframes.row), "the first run's keyframes are in the picture from the start"
    assert (len(space.keyframes.row) == there) == localise


@pytest.mark.slow
@pytest.mark.parametrize("zoom", [1.25, 1.5])
def test_a_zoomed_camera_that_is_said_to_be_the_maps_is_found_out(
    source: str, first: Path, zoom: float, caplog: pytest.LogCaptureFixture
) -> None:
    """Its frames fit the map from farther off, metres wrong; the map's points tell the focal length."""
    config = Config.model_validate({"frontend": {"n_features": 500}})
    seen = open_source(source, start=20, max_frames=30)
    width, height = seen.camera.size_px
    shift = [0.5 * (1 - zoom) * (width - 1), 0.5 * (1 - zoom) * (height - 1)]
    A = np.array([[zoom, 0, shift[0]], [0, zoom, shift[1]]])
    frames = [replace(f, image=cv2.warpAffine(f.image, A, (width, height))) for f in seen]
    with caplog.at_level(logging.WARNING):
        found = camera_that_fits(config, frames, seen.camera, first)
    assert own_focal_px(found) == pytest.approx(zoom * seen.camera.fx, rel=0.02)
    assert "it is taken for theirs" in caplog.text
    assert camera_that_fits(config, list(seen), seen.camera, first) is seen.camera
