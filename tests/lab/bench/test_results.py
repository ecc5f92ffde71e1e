"""The tables of README and docs: each with the commit that it was measured at."""

from __future__ import annotations

import importlib.util
import json
import shutil
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[3]
SUMMARY = {
    "source": "/data/walk",
    "frames": 100,
    "coverage": 0.987,
    "verdict": {"level": "usable"},
    "failures": 2,
    "recoveries": 1,
    "relocalised": 0,
    "merges": 1,
    "dropped": 3,
    "latency_ms": {"median": 20, "p99": 40},
    "cpu_ms_per_frame": 30,
}
SCORE = {"coverage_pct": 98.7, "ate_rmse_m": 0.125, "broken": 1, "judged": 9}
ROW = "| walk | as it is | 1 | 98.7 | 0.1250 | 1 of 9 | usable | 2 | 2 | 30 |"
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
    monkeypatch.setattr(module, "score_of", lambda _run, _source: SCORE)
    return module


def measured_sequence(results: ModuleType, out: Path, commit: str) -> None:
    results.begin(out, "sequences", commit)
    ended(out / "sequences" / "walk" / "as it is" / "100")


def ended(run: Path) -> None:
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


def test_runs_at_the_cameras_rate_stand_beside_those_of_another_system(results: ModuleType, tmp_path: Path) -> None:
    results.begin(tmp_path, "realtime", "cccc")
    for name in results.PEER:
        for seed in ("100", "101"):
            ended(tmp_path / "realtime" / name / seed)
    results.write(tmp_path)
    table = part_of(results.ROOT / "docs" / "results.md", "realtime")
    scores = "2 | 98.7 (98.7) | 0.1250 (0.1250) | 1 of 9, 1 of 9 | 2 usable | 3.0 (3.0) | 20 (20) | 40 (40) | 30 (30)"
    assert f"| kitti_03 | {scores} | 99.9, 0.81, 95 |" in table
    for page in ("README.md", "docs/index.md"):
        short = part_of(results.ROOT / page, "realtime beside ORB-SLAM3")
        assert short.startswith("Commit `cccc`, `make results`.\n")
        assert "\n| ORB-SLAM3 | 99.9, 0.81 |" in short
        assert "\n| dualslam | 98.7, 0.125 |" in short


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
