"""The tables of README and docs: each with the commit that it was measured at."""

from __future__ import annotations

import importlib.util
import json
import shutil
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[3]
SUMMARY = {"coverage": 0.987, "ate_rmse_m": 0.125, "failures": 2, "recoveries": 1, "relocalised": 0}
SUMMARY["cpu_ms_per_frame"] = 30
ROW = "| walk | as it is | 1 | 98.7 (98.7) | 0.125 (0.125) | 2 | 1 | 30 (30) |"
ROWS = (
    "| data: road | base | 15 | 16 | 93.8 |\n| data: road | Dual | 1 | 16 | 6.2 |\n| data: road | Dual+ | 3 | 16 | 19 |"
)
TABLES = f"### Table II: failures\n\n| a |\n|---|\n{ROWS}\n\n### Table IV: not asked for\n\n| b |\n"


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return benchmarks/results.py, which writes into copies of the pages."""
    spec = importlib.util.spec_from_file_location("results", ROOT / "benchmarks" / "results.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    (tmp_path / "pages" / "docs").mkdir(parents=True)
    for page in ("README.md", "docs/index.md", "docs/results.md"):
        shutil.copy(ROOT / page, tmp_path / "pages" / page)
    monkeypatch.setattr(module, "ROOT", tmp_path / "pages")
    return module


def measured_sequence(results: ModuleType, out: Path, commit: str) -> None:
    results.begin(out, "sequences", commit)
    run = out / "sequences" / "walk" / "as it is" / "100"
    run.mkdir(parents=True)
    (run / "summary.json").write_text(json.dumps(SUMMARY))


def part_of(page: Path, part: str) -> str:
    return page.read_text().partition(f"<!-- results: {part} -->\n")[2].partition("<!-- end -->")[0]


def test_each_table_names_the_commit_that_it_was_measured_at(results: ModuleType, tmp_path: Path) -> None:
    out, page = tmp_path / "out", results.ROOT / "docs" / "results.md"
    links = part_of(page, "links")
    measured_sequence(results, out, "aaaa")
    results.begin(out, "failures", "bbbb")
    (out / "failures").mkdir()
    (out / "failures" / "tables.md").write_text(TABLES)
    results.write(out)
    assert part_of(page, "sequences").startswith("Commit `aaaa`, `make results`.\n\n| sequence |")
    assert ROW in part_of(page, "sequences")
    for written in (results.ROOT / "README.md", results.ROOT / "docs" / "index.md"):
        short = part_of(written, "failures in short")
        assert short.startswith("Commit `bbbb`, `make results`.\n\n| recordings |")
        assert short.endswith("|---|---|---|\n| road | 15 of 16 | 1 of 16 |\n")
    assert part_of(page, "failures").startswith("Commit `bbbb`, `make results`.\n\n### Table II")
    assert ROWS in part_of(page, "failures")
    assert "not asked for" not in part_of(page, "failures")
    assert part_of(page, "links") == links  # what was not measured stands as it was


def test_a_part_is_not_continued_at_another_commit(results: ModuleType, tmp_path: Path) -> None:
    measured_sequence(results, tmp_path, "aaaa")
    results.begin(tmp_path, "sequences", "aaaa")
    results.begin(tmp_path, "links", "bbbb")  # another table, its own commit
    with pytest.raises(SystemExit, match=r"sequences in .* measured at aaaa, this is bbbb"):
        results.begin(tmp_path, "sequences", "bbbb")


def test_a_table_without_a_commit_is_not_written(results: ModuleType, tmp_path: Path) -> None:
    before = (results.ROOT / "README.md").read_text()
    measured_sequence(results, tmp_path, "aaaa")
    (tmp_path / "sequences.commit.txt").unlink()
    with pytest.raises(SystemExit, match="nothing says at which commit sequences"):
        results.write(tmp_path)
    assert (results.ROOT / "README.md").read_text() == before
