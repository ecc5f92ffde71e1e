"""`dualslam run` on several sources: a folder for each, and a table."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from dualslam.cli import main
from tests.cli.conftest import N_FRAMES

Install = Callable[..., None]


@pytest.fixture
def demos(folder: Path, tmp_path: Path) -> list[str]:
    """Two sequences, and between them a video that is none."""
    for name in ("a", "c"):
        shutil.copytree(folder, tmp_path / name)
    (tmp_path / "b.mp4").write_bytes(b"no video")
    return [str(tmp_path / name) for name in ("a", "b.mp4", "c")]


def table(out: Path) -> dict[str, dict[str, str]]:
    with (out / "runs.csv").open() as file:
        return {row["run"]: row for row in csv.DictReader(file)}


def test_each_source_has_a_folder_and_a_bad_one_ends_none_of_the_others(
    demos: list[str], fake: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", *demos, "--out", str(tmp_path / "runs"), "--fov", "90"]) == 2
    said = capsys.readouterr()
    assert "dualslam: b: " in said.err
    assert "2 of 3 are whole" in said.out
    assert "look at: b" in said.out
    rows = table(tmp_path / "runs")
    assert [rows[name]["coverage"] for name in ("a", "b", "c")] == ["1.0", "", "1.0"]
    assert "b.mp4" in rows["b"]["reasons"]
    assert (tmp_path / "runs" / "c" / "trajectory.txt").exists()


def test_runs_that_have_ended_are_kept_and_interrupted_ones_repeated(
    demos: list[str], fake: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["run", demos[0], demos[2], "--out", str(tmp_path / "runs")]
    assert main(command) == 0
    for name, interrupted in (("a", False), ("c", True)):
        path = tmp_path / "runs" / name / "summary.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"interrupted": interrupted, "coverage": 0.5}))
    assert main(command) == 0
    assert "[1/2] a: kept" in capsys.readouterr().out
    assert [row["coverage"] for row in table(tmp_path / "runs").values()] == ["0.5", "1.0"]


def test_a_lost_demonstration_is_named(
    demos: list[str], fake: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fake(lost=tuple(range(12, N_FRAMES)))
    main(["run", demos[0], demos[2], "--out", str(tmp_path / "runs")])
    assert "0 of 2 are whole" in capsys.readouterr().out


def test_names_take_as_many_parents_as_they_need(folder: Path, fake: Install, tmp_path: Path) -> None:
    """Pipelines keep each demonstration's video by one name in a folder of its own."""
    for name in ("one", "two"):
        shutil.copytree(folder, tmp_path / name / "raw")
    sources = [str(tmp_path / name / "raw") for name in ("one", "two")]
    assert main(["run", *sources, "--out", str(tmp_path / "runs"), "--quiet"]) == 0
    assert (tmp_path / "runs" / "two" / "raw" / "summary.json").exists()


def test_what_belongs_to_one_source_is_refused_for_several(
    demos: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", demos[0], demos[0], "--out", str(tmp_path / "runs")]) == 2
    assert "is named twice" in capsys.readouterr().err
    assert main(["run", demos[0], demos[2], "--out", str(tmp_path / "runs"), "--live"]) == 2
    assert "--live belongs to one source" in capsys.readouterr().err
