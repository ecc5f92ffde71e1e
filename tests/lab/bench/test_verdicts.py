"""Right and wrong runs, and the tables of verdicts, on records whose truth is known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dualslam.lab.bench.record import Fault, Join, JoinCause, Reason, TrialOutcome, TrialRecord, faults_of
from dualslam.lab.bench.spec import BenchSpec, RightRun
from dualslam.lab.bench.table import ResultTable
from dualslam.lab.bench.verdict_tables import area_under_roc, verdict_tables

RIGHT = RightRun()
GOOD = TrialRecord(
    *("a/x/v/00", "0", "a", "x", "v", 0, 0),
    status="ii" + "T" * 98,
    initialised_at=2,
    ate_m=1.0,
    path_m=100.0,
    n_clear=98,
    n_clear_posed=98,
    judged=9,
)
FALSE_JOIN = Join(50, "wrong", 3.0, 1.0, 0.1, JoinCause.LOSS)


@pytest.mark.parametrize(
    ("change", "faults"),
    [
        ({}, ()),
        ({"n_clear_posed": 94}, ()),
        ({"n_clear_posed": 93}, (Fault.COVERAGE,)),
        ({"ate_m": 2.1}, (Fault.ATE,)),
        ({"broken": 1}, (Fault.BROKEN,)),
        ({"excepted": 3}, ()),
        ({"joins": (FALSE_JOIN,), "broken": 2}, (Fault.BROKEN, Fault.FALSE_JOIN)),
        ({"joins": (replace(FALSE_JOIN, outcome="right"), replace(FALSE_JOIN, outcome="not joined"))}, ()),
        ({"status": "i" * 100, "initialised_at": None}, (Fault.NO_MAP,)),
        ({"status": "i" * 100, "initialised_at": None, "is_still": True}, ()),
        ({"is_still": True}, (Fault.STILL,)),
        ({"outcome": TrialOutcome.CRASHED, "error": "ZeroDivisionError: by zero"}, (Fault.CRASHED,)),
        ({"outcome": TrialOutcome.CRASHED, "error": "InputError: times in ms"}, (Fault.REFUSED,)),
    ],
)
def test_what_is_wrong_is_named(change: dict[str, Any], faults: tuple[Fault, ...]) -> None:
    assert faults_of(replace(GOOD, **change), RIGHT) == faults


def test_a_record_survives_its_line_and_one_from_before_verdicts_too() -> None:
    record = replace(GOOD, level="doubtful", reasons=(Reason("steps", 3, 9),), joins=(FALSE_JOIN,), dose=0.4)
    assert TrialRecord.from_dict(record.as_dict()) == record
    old = {k: v for k, v in GOOD.as_dict().items() if k not in ("joins", "reasons", "level", "dose", "is_still")}
    assert TrialRecord.from_dict(old) == GOOD


SPEC = BenchSpec.model_validate_json("""{
  "name": "verdicts",
  "sequences": [{"name": "a", "source": "a", "frames": 100}],
  "variants": [{"name": "v"}],
  "conditions": [
    {"name": "plain", "part": "plain"},
    {"name": "dark", "part": "disturbed", "corruptions": [{"kind": "exposure", "frames": 9, "strength": [-8, -1]}]}],
  "right": {}
}""")


def records() -> list[TrialRecord]:
    """Ten right runs, eight of them called good; six false ones, one of them called good. Dark below -4 stops."""
    made = []
    for n in range(10):
        level, reasons = ("good", ()) if n < 8 else ("doubtful", (Reason("steps", 1, 2),))
        made.append(
            replace(GOOD, condition="dark", dose=-1.0 - 0.3 * n, level=level, reasons=reasons, scores={"turn": n})
        )
    for n in range(6):
        level, reasons = ("good", ()) if n == 0 else ("doubtful", (Reason("steps", 1, 2),))
        false = replace(GOOD, condition="dark", dose=-4.3 - 0.3 * n, broken=2, joins=(FALSE_JOIN,))
        made.append(replace(false, level=level, reasons=reasons, scores={"turn": 4.5 + 2 * n}))
    made.append(replace(GOOD, condition="plain"))
    return made


@pytest.fixture(scope="module")
def tables() -> dict[str, ResultTable]:
    return {table.name: table for table in verdict_tables(SPEC, records())}


def rows(table: ResultTable) -> list[dict[str, Any]]:
    return [dict(zip(table.columns, row, strict=True)) for row in table.rows]


def test_how_often_good_is_right_and_right_is_good(tables: dict[str, ResultTable]) -> None:
    good, doubtful, none = rows(tables["verdicts"])
    assert [row["verdict"] for row in (good, doubtful, none)] == ["good", "doubtful", "none"]
    assert (good["runs"], good["right"], good["false maps"]) == (9, 8, 1)
    assert good["right %"] == pytest.approx(100 * 8 / 9)
    # Wilson's interval of 8 in 9, from its formula.
    z2 = 1.959964**2
    middle, half = (8 + z2 / 2) / (9 + z2), np.sqrt(8 / 9 / 9 * 9 + z2 / 4) * np.sqrt(z2) / (9 + z2)
    assert (good["low %"], good["high %"]) == pytest.approx((100 * (middle - half), 100 * (middle + half)), rel=1e-4)
    assert good["of all right runs %"] == pytest.approx(100 * 8 / 11)
    assert (none["runs"], none["right"]) == (1, 1)


def test_faults_are_counted_by_condition(tables: dict[str, ResultTable]) -> None:
    plain, dark = rows(tables["faults"])
    assert (plain["part"], plain["runs"], plain["right"]) == ("plain", 1, 1)
    assert (dark["runs"], dark["right"], dark["false maps"], dark["broken"], dark["error"]) == (16, 10, 6, 6, 0)


def test_a_reason_is_as_good_as_its_area(tables: dict[str, ResultTable]) -> None:
    steps, turn = rows(tables["reasons"])
    assert (steps["code"], steps["given"], steps["to wrong runs"], steps["to right runs"]) == ("steps", 7, 5, 2)
    # Of 60 pairs the five wrong runs that give it win 40 and tie 10; the sixth ties with eight and loses to two.
    assert steps["area under ROC"] == pytest.approx((40 + 10 / 2 + 8 / 2) / 60)
    # Scores 0 to 9 of right runs against 4.5, 6.5, 8.5 and three above all.
    assert (turn["code"], turn["given"], turn["runs with a score"]) == ("turn", 0, 16)
    assert turn["area under ROC"] == pytest.approx((5 + 7 + 9 + 3 * 10) / 60)
    assert area_under_roc(np.ones(3), np.ones(3, bool)) is None


def test_the_critical_strength_of_darkness_is_in_stops(tables: dict[str, ResultTable]) -> None:
    (dark,) = rows(tables["critical_strengths"])
    assert (dark["condition"], dark["dose"], dark["runs"], dark["not right"]) == ("dark", "strength", 16, 6)
    assert dark["half fail at"] == pytest.approx(-4.0, abs=0.15)
    assert dark["high"] < dark["half fail at"] < dark["low"]


def test_losses_and_undoubted_false_maps_are_listed(tables: dict[str, ResultTable]) -> None:
    all_ = rows(tables["joins"])[-1]
    assert [all_[f"loss: {how}"] for how in ("joined right", "joined wrong", "not joined")] == [0, 6, 0]
    assert all_["disturbance: joined wrong"] == 0
    (false,) = rows(tables["silently_false"])
    assert (false["verdict"], false["faults"], false["dose"]) == ("good", "broken, false join", -4.3)


def test_a_bench_that_does_not_say_what_is_right_has_none_of_these() -> None:
    assert verdict_tables(SPEC.model_copy(update={"right": None}), records()) == []
