"""The figures of a bench: that they are there, and that a status has its colour."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from dualslam.cli.bench_command import draw_figures
from dualslam.lab.bench.plan import plan_trials
from dualslam.lab.bench.tables import bench_tables
from dualslam.report.bench_figures import draw_statuses
from tests.lab.bench.fakes import SPEC, describe, run_fake


@pytest.mark.slow
def test_every_figure_is_drawn(tmp_path: Path) -> None:
    records = [run_fake(trial) for trial in plan_trials(SPEC, describe)]
    files = draw_figures(SPEC, bench_tables(SPEC, records), records, tmp_path)
    names = {"table_2_failures", "figure_6_initialisation", "figure_7_a", "figure_7_b", "figure_9_end_point"}
    assert {file.stem for file in files} == names
    assert {file.stem for file in files if file.suffix == ".pdf"} == names
    for file in (file for file in files if file.suffix != ".pdf"):
        image = cv2.imread(str(file))
        assert image is not None
        assert min(image.shape[:2]) > 200
        assert len(np.unique(image.reshape(-1, 3), axis=0)) > 5


def test_a_sequence_that_no_condition_takes_has_no_figure(tmp_path: Path) -> None:
    records = [run_fake(trial) for trial in plan_trials(SPEC, describe) if trial.sequence == "a"]
    files = draw_figures(SPEC, bench_tables(SPEC, records), records, tmp_path)
    assert {file.stem for file in files if file.stem.startswith("figure_7")} == {"figure_7_a"}
    assert all(file.exists() for file in files)


def test_without_matplotlib_the_tables_are_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dualslam.cli.bench_command.find_spec", lambda name: None)
    assert draw_figures(SPEC, [], [], tmp_path) == []
    assert not list(tmp_path.iterdir())


def test_frames_go_upwards_and_a_status_has_its_colour(tmp_path: Path) -> None:
    draw_statuses(tmp_path / "f.png", "x", {"c": {"v": ["T" * 50 + "l" * 50]}})
    image = cv2.imread(str(tmp_path / "f.png"))
    assert image is not None
    rows = {}
    for name, bgr in {"main": (0x73, 0x9E, 0x00), "lost": (0x00, 0x5E, 0xD5)}.items():
        mask = np.abs(image.astype(int) - bgr).max(axis=2) < 3
        assert mask.sum() > 1000
        # The legend stands below; the panel is the larger part.
        rows[name] = np.median(np.flatnonzero(mask.any(axis=1)))
    assert rows["lost"] < rows["main"]
