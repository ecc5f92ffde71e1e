from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from dualslam.cli import main
from dualslam.report import comparison_page, comparison_table, read_run
from dualslam.report.compare import run_names
from tests.cli.conftest import _own_environment  # noqa: F401 (used by every test)
from tests.report.conftest import N_FRAMES, MakeRun
from tests.report.test_report import Outline


@pytest.fixture(scope="module")
def pair(make_run: MakeRun) -> list[Path]:
    return [make_run(name="base"), make_run(lost=(), name="dual")]


def test_the_table_puts_the_numbers_side_by_side(pair: list[Path]) -> None:
    table = {row[0]: row[1:] for row in comparison_table([read_run(path) for path in pair])}
    assert table[""] == ["base", "dual"]
    assert table["coverage"] == ["50.0 %", "100.0 %"]
    assert table["failures"] == ["1", "0"]
    for measure in ("relocalisations", "loops closed", "maps merged"):
        assert table[measure] == ["0", "0"]
    assert all(cell.endswith(" m") for cell in table["ATE"])


def test_the_command_prints_it_and_writes_a_page(
    pair: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "both.html"
    command = ["compare", *map(str, pair), "--out", str(out)]
    assert main(command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["base", "dual"]
    assert ["coverage", "50.0", "%", "100.0", "%"] in [line.split() for line in lines]
    found = Outline(out.read_text())
    assert len(found.of_class("run0")) >= 1
    assert len(found.of_class("run1")) >= 1
    assert "All runs have the same configuration." in found.text
    assert main(command) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main([*command, "--overwrite", "--quiet"]) == 0
    assert capsys.readouterr().out == ""


def test_the_same_frame_stands_at_the_same_place_in_each_strip(pair: list[Path]) -> None:
    runs = [read_run(path) for path in pair]
    late = replace(runs[1], rows=[replace(row, index=row.index + 20) for row in runs[1].rows])
    found = Outline(comparison_page([runs[0], late]))
    (lost,) = found.of_class("st-lost")[:1]
    assert (lost["x"], lost["width"]) == ("20", "6")
    assert {a["x"] for a in found.of_class("st-tracked") if a.get("width") == str(N_FRAMES)} == {"20"}


def test_errors_over_time_are_to_one_scale(pair: list[Path]) -> None:
    runs = [read_run(path) for path in pair]
    found = Outline(comparison_page(runs))
    assert "Error over time" in found.text
    assert len(found.of_class("error")) >= len(runs)
    nothing = replace(runs[0].truth, row=runs[0].truth.row[:0], T_map_cam=runs[0].truth.T_map_cam[:0])
    assert "Error over time" not in comparison_page([replace(run, truth=nothing) for run in runs])


def test_what_is_no_run_is_named(pair: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", str(pair[0]), str(tmp_path), "--out", str(tmp_path / "x.html")]) == 2
    assert "is not the folder of a finished run" in capsys.readouterr().err
    assert not (tmp_path / "x.html").exists()


@pytest.mark.slow
def test_without_truth_the_maps_are_laid_on_the_first(make_run: MakeRun) -> None:
    runs = [read_run(make_run(truth=False, lost=lost, name="phone")) for lost in ((), (5, 6, 7), ())]
    found = Outline(comparison_page(runs))
    assert "aligned to the first one's" in found.text
    for i in range(3):
        assert found.of_class(f"run{i}")
    assert len(set(run_names(runs))) == 3


def test_runs_without_a_map_are_compared_all_the_same(make_run: MakeRun) -> None:
    none = read_run(make_run(lost=tuple(range(N_FRAMES)), name="none"))
    page = comparison_page([none, none])
    assert "None of the runs has a map." in Outline(page).text
    assert run_names([none, none]) == ["1 none", "2 none"]


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("summary.json", "{"),
        ("summary.json", "[]"),
        ("map/map.json", "{"),
        ("map/map.json", '{"groups": [3], "metadata": {}}'),
        ("map/links.npz", "x"),
        ("map/submap_00.npz", "x"),
        ("events.jsonl", "3\n"),
        ("config.yaml", "seed: [\n"),
        ("config.yaml", "- 1\n"),
        ("frames.csv", "x\n"),
    ],
)
def test_a_damaged_file_is_named(
    pair: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], file: str, content: str
) -> None:
    run = tmp_path / "damaged"
    shutil.copytree(pair[0], run)
    assert (run / file).exists()
    (run / file).write_text(content)
    assert main(["compare", str(run), str(pair[1]), "--out", str(tmp_path / "page.html")]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert str(run / file) in captured.err or (file.startswith("map/") and str(run / "map") in captured.err)
    assert not (tmp_path / "page.html").exists()
