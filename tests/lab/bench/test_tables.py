"""The tables of a bench whose outcome is known, against what a person counts."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path

import pytest
from scipy import stats

from dualslam.lab.bench.plan import plan_trials
from dualslam.lab.bench.record import Breakage
from dualslam.lab.bench.recovery_tables import count_attempts
from dualslam.lab.bench.table import ResultTable
from dualslam.lab.bench.tables import bench_tables
from dualslam.lab.bench.write_tables import write_tables
from tests.lab.bench.fakes import SPEC, describe, run_fake

# In `run_fake`: 2 sequences; natural 3 trials each, all good; a black-out 3 trials each and a fault 3 trials on one
# sequence: the base loses all nine, Dual links at attempt 1, at attempt 2, and crashes.
RECORDS = [run_fake(trial) for trial in plan_trials(SPEC, describe)]


@pytest.fixture(scope="module")
def tables() -> dict[str, ResultTable]:
    return {table.name: table for table in bench_tables(SPEC, RECORDS)}


def rows_of(table: ResultTable) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(table.csv())))


def test_latex_has_the_cells_of_markdown_and_nothing_that_latex_reads_as_a_command(
    tables: dict[str, ResultTable],
) -> None:
    for table in tables.values():
        begin, top, *lines, bottom, end, last = table.latex().split("\n")[1:]
        assert begin == rf"\begin{{tabular}}{{{begin[16:-1]}}}"
        assert len(begin[16:-1]) == len(table.columns)
        assert (top, lines[1], bottom, end, last) == (r"\toprule", r"\midrule", r"\bottomrule", r"\end{tabular}", "")
        rows = [lines[0], *lines[2:]]
        assert len(rows) == 1 + len(table.rows)
        for row in rows:
            assert row.endswith(r" \\")
            assert row.isascii()
            assert len(re.findall(r"(?<!\\)&", row)) == len(table.columns) - 1
            assert not re.search(r"(?<!\\)[%#_]", row)
    table = ResultTable("t", "T", ("a_b", "n"), [["50 % & more", 0.123456], ["x", None]], "note")
    assert table.latex().split("\n")[3:7] == [r"a\_b & n \\", r"\midrule", r"50 \% \& more & 0.123 \\", r"x & - \\"]


def test_table_1(tables: dict[str, ResultTable]) -> None:
    rows = {(r["sequence"], r["condition"]): r for r in rows_of(tables["table_1_rmse"])}
    assert list(rows) == [("a", "natural"), ("a", "blackout"), ("a", "fault"), ("b", "natural"), ("b", "blackout")]
    natural, black = rows["a", "natural"], rows["a", "blackout"]
    assert (natural["base RMSE m"], natural["base failed"]) == ("0.6", "")
    # The base's small error is that of half a trajectory: it failed, so that it does not count.
    assert (black["base RMSE m"], black["base failed"]) == ("", "⊗ 3/3")
    assert (black["Dual RMSE m"], black["Dual failed"]) == ("0.55", "↷ 1/3")


def test_table_2(tables: dict[str, ResultTable]) -> None:
    rows = {(r["which trials"], r["variant"]): r for r in rows_of(tables["table_2_failures"])}
    counts = {key: (row["failures"], row["trials"]) for key, row in rows.items() if key[1] == "base"}
    assert counts == {
        ("cause: natural", "base"): ("0", "6"),
        ("cause: image", "base"): ("6", "6"),
        ("cause: internal", "base"): ("3", "3"),
        ("cause: natural and image", "base"): ("6", "12"),
        ("data: one", "base"): ("6", "9"),
        ("data: two", "base"): ("3", "6"),
        ("all", "base"): ("9", "15"),
    }
    dual = rows["cause: natural and image", "Dual"]
    assert (dual["failures"], dual["trials"]) == ("2", "12")
    assert float(dual["reduction %"]) == pytest.approx(100 * (1 - 2 / 6))
    # Two clusters in which the base fails say nothing about others.
    assert (dual["reduction low %"], dual["reduction high %"]) == ("", "")
    wilson = stats.binomtest(2, 12).proportion_ci(method="wilson")
    assert float(dual["rate low %"]) == pytest.approx(100 * wilson.low)
    assert float(dual["rate high %"]) == pytest.approx(100 * wilson.high)
    assert rows["cause: natural", "Dual"]["reduction %"] == ""


def test_the_interval_of_the_reduction() -> None:
    """Six clusters, in each of which one failure of three is left: no resample differs."""
    many = tuple(SPEC.sequences[0].model_copy(update={"name": f"s{i}"}) for i in range(6))
    spec = SPEC.model_copy(update={"sequences": many, "conditions": SPEC.conditions[:2]})
    records = [run_fake(trial) for trial in plan_trials(spec, describe)]
    (dual,) = [
        r for r in rows_of(bench_tables(spec, records)[1]) if (r["which trials"], r["variant"]) == ("all", "Dual")
    ]
    bounds = [float(dual[name]) for name in ("reduction %", "reduction low %", "reduction high %")]
    assert bounds == pytest.approx([100 * 2 / 3] * 3)


def test_reasons(tables: dict[str, ResultTable]) -> None:
    base, dual = rows_of(tables["failure_reasons"])
    assert (base["good"], base["coverage"], base["crashed"]) == ("6", "9", "0")
    assert (dual["good"], dual["coverage"], dual["crashed"]) == ("12", "0", "3")


def test_table_3(tables: dict[str, ResultTable]) -> None:
    base, first, second = rows_of(tables["table_3_recoveries"])
    assert (base["losses"], base["recovered"], base["attempt"]) == ("9", "0", "")
    assert (first["trials"], first["with a loss"], first["losses"], first["recovered"]) == ("15", "6", "6", "6")
    assert (first["attempt"], first["made"], first["succeeded"]) == ("1", "6", "3")
    # The second attempt is made where the first one failed, and there alone.
    assert (second["attempt"], second["made"], second["succeeded"], second["success %"]) == ("2", "3", "3", "100.0")
    assert float(first["mean s"]) == pytest.approx((3 * 2 + 3 * 4) / 6)
    assert float(first["longest s"]) == 4.0


def test_equation_1(tables: dict[str, ResultTable]) -> None:
    base, dual = rows_of(tables["equation_1"])
    assert float(base["p0"]) == float(base["observed"]) == pytest.approx(9 / 15)
    assert float(dual["p0"]) == pytest.approx(6 / 15)
    assert dual["p_r of each attempt, given that those before it failed"] == "0.5, 0"
    assert float(dual["p0 p_r^n as if independent"]) == pytest.approx(6 / 15 * 0.25)
    assert float(dual["p0 times these"]) == float(dual["observed"]) == 0


def test_the_papers_own_table_3() -> None:
    """Dual-SLAM on TUM-Mono: 125 needed recovery, 106 succeeded with one attempt, 5 with two."""
    lost = Breakage(10, 0, "x")
    breakages = [Breakage(10, 0, "x", attempts=1, succeeded_at=1)] * 106
    breakages += [Breakage(10, 0, "x", attempts=2, succeeded_at=2)] * 5 + [Breakage(10, 0, "x", attempts=2)] * 14
    first, second = count_attempts(breakages)
    assert (first.tried, first.succeeded) == (125, 106)
    assert (second.tried, second.succeeded) == (19, 5)
    # Attempts are not independent: the second one fails five times as often.
    assert first.failure_rate == pytest.approx(0.152)
    assert second.failure_rate == pytest.approx(0.737, abs=1e-3)
    assert count_attempts([lost]) == []


def test_figures_6_and_9(tables: dict[str, ResultTable]) -> None:
    base, dual = rows_of(tables["figure_6_initialisation"])
    assert (base["median frames"], base["never"], base["losses"], base["again: median s"]) == ("4", "0", "9", "0.5")
    assert dual["never"] == "3"  # the crashed ones
    (b,) = rows_of(tables["figure_9_end_point"])
    assert (b["sequence"], b["base m"], b["base failed"], b["Dual failed"]) == ("b", "0.3", "↷ 3/6", "↷ 1/6")


def test_an_unfinished_bench_compares_what_both_have() -> None:
    records = [r for r in RECORDS if not (r.variant == "Dual" and r.number == 2)]
    rows = {(r["which trials"], r["variant"]): r for r in rows_of(bench_tables(SPEC, records)[1])}
    assert float(rows["cause: image", "Dual"]["reduction %"]) == 100
    assert rows["cause: image", "base"]["failures"] == "6"


def test_what_is_written(tmp_path: Path) -> None:
    tables = bench_tables(SPEC, RECORDS)
    written = write_tables(SPEC, tables, RECORDS, tmp_path, "dualslam bench fake.yaml")
    page = (tmp_path / "tables.md").read_text()
    assert "`dualslam bench fake.yaml`: 30 trials of the reporting half, seed 0" in page
    assert "| a | blackout | - | ⊗ 3/3 | 0.55 | ↷ 1/3 |" in page
    assert len(written) == 2 * len(tables) + 2
    trials = list(csv.DictReader(io.StringIO((tmp_path / "tables" / "trials.csv").read_text())))
    assert len(trials) == 30
    crashed = [t for t in trials if t["failed"] == "crashed"]
    assert len(crashed) == 3
    assert all("by zero" in t["error"] for t in crashed)
