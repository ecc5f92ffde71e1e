"""Whether the verdict of a run is true, what fails at which strength, and how losses are joined."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np

from dualslam.lab.audits.join_audit import JoinOutcome
from dualslam.lab.bench.record import FALSE_MAP, NO_VERDICT, Fault, JoinCause, TrialRecord, faults_of
from dualslam.lab.bench.spec import BenchSpec, RightRun
from dualslam.lab.bench.table import Cell, ResultTable
from dualslam.lab.metrics.dose_response import critical_dose
from dualslam.lab.metrics.statistics import wilson_interval

LEVELS = ("good", "usable", "doubtful", NO_VERDICT)
GOOD = "good"


def verdict_tables(spec: BenchSpec, records: Sequence[TrialRecord]) -> list[ResultTable]:
    """Return the tables of a bench that says when a run is right; none of another bench.

    Parameters
    ----------
    spec : BenchSpec
    records : sequence of TrialRecord
        Of all trials, or of those that there are.
    """
    if spec.right is None:
        return []
    right = spec.right
    return [
        _truth_table(records, right),
        _fault_table(spec, records, right),
        _reason_table(records, right),
        _critical_table(spec, records, right),
        _join_table(spec, records),
        _false_table(records, right),
    ]


def _is_right(record: TrialRecord, right: RightRun) -> bool:
    return not faults_of(record, right)


def _share(k: int, n: int) -> list[Cell]:
    wilson = wilson_interval(k, n)
    return [100.0 * k / n if n else None, 100.0 * wilson.low, 100.0 * wilson.high]


def _truth_table(records: Sequence[TrialRecord], right: RightRun) -> ResultTable:
    n_right = sum(_is_right(r, right) for r in records)
    rows: list[list[Cell]] = []
    for level in LEVELS:
        runs = [r for r in records if r.level == level]
        if not runs:
            continue
        faults = [faults_of(r, right) for r in runs]
        k = faults.count(())
        false = sum(bool(FALSE_MAP & set(found)) for found in faults)
        rows.append([level, len(runs), k, *_share(k, len(runs)), false, *_share(k, n_right)])
    return ResultTable(
        "verdicts",
        "How often a verdict is true",
        (
            *("verdict", "runs", "right", "right %", "low %", "high %", "false maps"),
            *("of all right runs %", "of right low %", "of right high %"),
        ),
        rows,
        f"A run is right if {100 * right.min_coverage:g} % of the undisturbed frames from the first initialisation on "
        f"are in the main map, no stretch is broken, the RMS error is below {100 * right.max_ate:g} % of the path, and "
        "no part is joined falsely. Wilson's 95 % intervals.",
    )


def _fault_table(spec: BenchSpec, records: Sequence[TrialRecord], right: RightRun) -> ResultTable:
    rows: list[list[Cell]] = []
    for condition in spec.conditions:
        faults = [faults_of(r, right) for r in records if r.condition == condition.name]
        if not faults:
            continue
        false = sum(bool(FALSE_MAP & set(found)) for found in faults)
        each = [sum(fault in found for found in faults) for fault in Fault]
        rows.append([condition.part, condition.name, len(faults), faults.count(()), false, *each])
    return ResultTable(
        "faults",
        "What keeps runs from being right",
        ("part", "condition", "runs", "right", "false maps", *map(str, Fault)),
        rows,
        "A run may have several faults. False maps have a broken stretch, too large an error, a false join, or show a "
        "camera that stood still as moving.",
    )


def _reason_table(records: Sequence[TrialRecord], right: RightRun) -> ResultTable:
    judged = [r for r in records if r.level != NO_VERDICT]
    is_right = np.array([_is_right(r, right) for r in judged], bool)
    codes = {reason.code for r in judged for reason in r.reasons} | {code for r in judged for code in r.scores}
    rows: list[list[Cell]] = []
    for code in sorted(codes):
        given = np.array([any(reason.code == code for reason in r.reasons) for r in judged], bool)
        scored = np.array([code in r.scores for r in judged], bool)
        if not scored.any():
            score, scored = given.astype(np.float64), np.ones(len(judged), bool)
        else:
            score = np.array([r.scores.get(code, 0.0) for r in judged])
        n_right = int((given & is_right).sum())
        area = area_under_roc(score[scored], ~is_right[scored])
        rows.append([code, int(given.sum()), int(given.sum()) - n_right, n_right, int(scored.sum()), area])
    return ResultTable(
        "reasons",
        "Reasons",
        ("code", "given", "to wrong runs", "to right runs", "runs with a score", "area under ROC"),
        rows,
        "Area: the chance that the wrong run has the higher score of a wrong and a right one (0.5: no use). Where no "
        "run has a score for a reason, a run that gives it counts as 1, another as 0.",
    )


def area_under_roc(score: np.ndarray, positive: np.ndarray) -> float | None:
    """Return the chance that a positive scores higher than a negative, ties counted half; None without either."""
    high, low = score[positive], score[~positive]
    if not len(high) or not len(low):
        return None
    difference = high[:, None] - low[None, :]
    return float(((difference > 0) + 0.5 * (difference == 0)).mean())


def _critical_table(spec: BenchSpec, records: Sequence[TrialRecord], right: RightRun) -> ResultTable:
    rows: list[list[Cell]] = []
    for condition in spec.conditions:
        if (dosed := condition.dosed) is None:
            continue
        runs = [r for r in records if r.condition == condition.name and r.dose is not None]
        doses = np.array([r.dose for r in runs if r.dose is not None])
        failed = np.array([not _is_right(r, right) for r in runs], bool)
        falling = len(doses) > 0 and doses.max() <= 0  # stops of darkness: the lower, the worse
        sign = -1.0 if falling else 1.0
        found = critical_dose(sign * doses, failed)
        if found is None:
            continue
        ends = [sign * found.interval.low, sign * found.interval.high]
        shown: Cell = sign * found.value if found.value is not None else "beyond" if found.is_above else "below"
        tried = f"{min(doses, key=abs):.3g} to {max(doses, key=abs):.3g}"
        rows.append([condition.name, dosed.dose_unit, tried, len(runs), int(failed.sum()), shown, *ends])
    return ResultTable(
        "critical_strengths",
        "Critical strengths",
        ("condition", "dose", "tried", "runs", "not right", "half fail at", "low", "high"),
        rows,
        "Logistic fit with its 95 % profile-likelihood interval, cut at the doses that were tried. Beyond, below: half "
        "succeed at the strongest dose, or fail at the weakest.",
    )


def _join_table(spec: BenchSpec, records: Sequence[TrialRecord]) -> ResultTable:
    causes = (JoinCause.DISTURBANCE, JoinCause.LOSS)
    rows: list[list[Cell]] = []
    totals: Counter[tuple[JoinCause, str]] = Counter()
    for condition in spec.conditions:
        joins = [j for r in records if r.condition == condition.name for j in r.joins if j.cause in causes]
        totals.update(count := Counter((j.cause, j.outcome) for j in joins))
        if count:
            rows.append([condition.part, condition.name, *_join_cells(count, causes)])
    rows.append(["all", "all", *_join_cells(totals, causes)])
    columns = [f"{cause}: {_JOINED[outcome]}" for cause in causes for outcome in JoinOutcome]
    return ResultTable(
        "joins",
        "Disturbances and losses",
        ("part", "condition", *columns),
        rows,
        "Passing disturbances and losses of a map, judged by up to 45 posed frames on either side. Joined wrong: off "
        "by more than 5 % of the path (in a world that repeats: half its period), 15 % in scale or 5 degrees.",
    )


_JOINED = {
    JoinOutcome.RIGHT: "joined right",
    JoinOutcome.WRONG: "joined wrong",
    JoinOutcome.NOT_JOINED: "not joined",
}


def _join_cells(count: Counter[tuple[JoinCause, str]], causes: Iterable[JoinCause]) -> list[Cell]:
    return [count[cause, str(outcome)] for cause in causes for outcome in JoinOutcome]


def _false_table(records: Sequence[TrialRecord], right: RightRun) -> ResultTable:
    rows: list[list[Cell]] = []
    for r in records:
        faults = faults_of(r, right)
        if not FALSE_MAP & set(faults) or r.level not in (GOOD, NO_VERDICT):
            continue
        error = 100 * r.ate_m / r.path_m if r.ate_m is not None and r.path_m else None
        worst = max(
            (j.offset_m for j in r.joins if j.outcome == JoinOutcome.WRONG and j.offset_m is not None), default=None
        )
        cells: list[Cell] = [r.key, r.level, ", ".join(faults), r.dose, 100 * r.coverage, error, r.broken, r.judged]
        rows.append([*cells, worst, len(r.breakages)])
    return ResultTable(
        "silently_false",
        "False maps that no verdict doubts",
        (
            *("trial", "verdict", "faults", "dose", "coverage %", "ATE, % of path", "broken", "judged"),
            *("worst false join m", "losses"),
        ),
        rows,
        "Runs whose map is false and that are called good, or that give no verdict.",
    )
