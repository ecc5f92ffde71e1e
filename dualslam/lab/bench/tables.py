"""The tables of the paper from the lines of a bench. A trial that failed, however, is in all of them."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from dualslam.core.config.corruption import Cause
from dualslam.lab.bench.record import FailureKind, TrialRecord, judge
from dualslam.lab.bench.recovery_tables import recovery_table, redundancy_table
from dualslam.lab.bench.spec import BenchSpec
from dualslam.lab.bench.table import Cell, ResultTable
from dualslam.lab.metrics.statistics import failure_reduction, wilson_interval

ALL_FAILED, SOME_FAILED = "⊗", "↷"


@dataclass(frozen=True, slots=True)
class _Counted:
    """The records of a bench, with the verdict on each."""

    spec: BenchSpec
    records: Sequence[TrialRecord]

    def failed(self, record: TrialRecord) -> bool:
        return judge(record, self.spec.thresholds) is not None

    def of(self, variant: str) -> list[TrialRecord]:
        return [r for r in self.records if r.variant == variant]

    def failures(self, records: Iterable[TrialRecord]) -> int:
        return sum(self.failed(r) for r in records)

    @property
    def clusters(self) -> list[tuple[str, str]]:
        """(sequence, condition) in the order in which they were met."""
        return list(dict.fromkeys((r.sequence, r.condition) for r in self.records))


def bench_tables(spec: BenchSpec, records: Sequence[TrialRecord]) -> list[ResultTable]:
    """Return all tables of a bench.

    Parameters
    ----------
    spec : BenchSpec
    records : sequence of TrialRecord
        Of all trials, or of those that there are.
    """
    counted = _Counted(spec, records)
    tables = [
        _rmse_table(counted),
        _failure_table(counted),
        _reasons_table(counted),
        recovery_table(spec, records),
        redundancy_table(spec, records),
        _initialisation_table(counted),
    ]
    if any(sequence.returns_to_start for sequence in spec.sequences):
        tables.append(_end_point_table(counted))
    return tables


def _rmse_table(counted: _Counted) -> ResultTable:
    """Table I."""
    rows: list[list[Cell]] = []
    for sequence, condition in counted.clusters:
        row: list[Cell] = [sequence, condition]
        for variant in counted.spec.variant_names:
            trials = [r for r in counted.of(variant) if (r.sequence, r.condition) == (sequence, condition)]
            errors = [r.ate_m for r in trials if r.ate_m is not None and not counted.failed(r)]
            row += [statistics.median(errors) if errors else None, _mark(counted.failures(trials), len(trials))]
        rows.append(row)
    columns = [c for v in counted.spec.variant_names for c in (f"{v} RMSE m", f"{v} failed")]
    return ResultTable(
        "table_1_rmse",
        "Table I: median RMSE",
        ("sequence", "condition", *columns),
        rows,
        f"Median of the trials that did not fail, after one Sim(3) alignment of the main map. {SOME_FAILED}: some "
        f"trials failed; {ALL_FAILED}: all of them.",
    )


def _mark(n_failed: int, n: int) -> str:
    if not n_failed:
        return ""
    return f"{ALL_FAILED if n_failed == n else SOME_FAILED} {n_failed}/{n}"


def _failure_table(counted: _Counted) -> ResultTable:
    """Table II."""
    spec = counted.spec
    rows = [
        [name, variant, *_failure_cells(counted, variant, conditions, sequences)]
        for name, conditions, sequences in _sections(spec)
        for variant in spec.variant_names
    ]
    return ResultTable(
        "table_2_failures",
        "Table II: failures",
        (
            *("which trials", "variant", "failures", "trials", "rate %", "rate low %", "rate high %"),
            *("reduction %", "reduction low %", "reduction high %"),
        ),
        rows,
        f"Rates with Wilson's 95 % interval. Reduction of failures against {spec.reference_name} with the 95 % "
        "interval of a bootstrap over clusters (a sequence in a condition), where at least five of them failed. "
        "Internal causes are faults forced inside the system.",
    )


def _sections(spec: BenchSpec) -> list[tuple[str, set[str], set[str]]]:
    """Return what failures are counted over: a name, conditions and sequences."""
    everything = {condition.name for condition in spec.conditions}, {sequence.name for sequence in spec.sequences}
    by_cause = {cause: {c.name for c in spec.conditions if c.cause is cause} for cause in Cause}
    sections = [(f"cause: {cause}", names, everything[1]) for cause, names in by_cause.items() if names]
    if by_cause[Cause.NATURAL] and by_cause[Cause.IMAGE]:
        outside = by_cause[Cause.NATURAL] | by_cause[Cause.IMAGE]
        sections.append(("cause: natural and image", outside, everything[1]))
    groups = list(dict.fromkeys(sequence.group for sequence in spec.sequences))
    if len(groups) > 1:
        sections += [(f"data: {g}", everything[0], {s.name for s in spec.sequences if s.group == g}) for g in groups]
    return sections if len(sections) == 1 else [*sections, ("all", *everything)]


def _failure_cells(counted: _Counted, variant: str, conditions: set[str], sequences: set[str]) -> list[Cell]:
    def of(name: str) -> list[TrialRecord]:
        return [r for r in counted.of(name) if r.condition in conditions and r.sequence in sequences]

    trials = of(variant)
    k, n = counted.failures(trials), len(trials)
    wilson = wilson_interval(k, n)
    cells: list[Cell] = [k, n, 100 * k / n if n else None, 100 * wilson.low, 100 * wilson.high]
    if variant == counted.spec.reference_name:
        return [*cells, None, None, None]
    # On the trials that both have: a bench that is not finished may lack some.
    both = {_trial_of(r) for r in trials} & {_trial_of(r) for r in of(counted.spec.reference_name)}
    clusters = [c for c in counted.clusters if c[0] in sequences and c[1] in conditions]
    sums = {}
    for name in (counted.spec.reference_name, variant):
        shared = [r for r in of(name) if _trial_of(r) in both]
        sums[name] = [counted.failures(r for r in shared if (r.sequence, r.condition) == c) for c in clusters]
    reduction = failure_reduction(sums[counted.spec.reference_name], sums[variant], seed=counted.spec.seed)
    if reduction.value is None:
        return [*cells, None, None, None]
    cells.append(100 * reduction.value)
    if reduction.interval is None:
        return [*cells, None, None]
    return [*cells, 100 * reduction.interval.low, 100 * reduction.interval.high]


def _trial_of(record: TrialRecord) -> tuple[str, str, int]:
    return record.sequence, record.condition, record.number


def _reasons_table(counted: _Counted) -> ResultTable:
    rows: list[list[Cell]] = []
    for variant in counted.spec.variant_names:
        verdicts = [judge(r, counted.spec.thresholds) for r in counted.of(variant)]
        rows.append([variant, len(verdicts), verdicts.count(None), *(verdicts.count(kind) for kind in FailureKind)])
    limits = counted.spec.thresholds
    return ResultTable(
        "failure_reasons",
        "Why trials failed",
        ("variant", "trials", "good", *map(str, FailureKind)),
        rows,
        f"Coverage: fewer than {100 * limits.min_coverage:g} % of the frames from the first initialisation on are in "
        f"the main map. Error: RMSE above {100 * limits.max_ate:g} % of the path. Wrong link: one is off by "
        f"more than {100 * limits.max_link_scale:g} % in scale, {limits.max_link_rotation_deg:g} deg or "
        f"{100 * limits.max_link_position:g} % of the linked path. The first that holds, left to right, is counted.",
    )


def _initialisation_table(counted: _Counted) -> ResultTable:
    """The numbers of Fig. 6."""
    rows: list[list[Cell]] = []
    for variant in counted.spec.variant_names:
        trials = counted.of(variant)
        frames = [r.initialised_at for r in trials if r.initialised_at is not None]
        seconds = [r.initialised_after_s for r in trials if r.initialised_after_s is not None]
        restarts = [b.restart_s for r in trials for b in r.breakages]
        again = [s for s in restarts if s is not None]
        row: list[Cell] = [variant, len(trials), len(trials) - len(frames)]
        row += [_median(frames), max(frames, default=None), _median(seconds), max(seconds, default=None)]
        row += [len(restarts), len(restarts) - len(again), _median(again), max(again, default=None)]
        rows.append(row)
    return ResultTable(
        "figure_6_initialisation",
        "Initialisation delay (Fig. 6)",
        (
            *("variant", "trials", "never", "median frames", "largest frames", "median s", "largest s"),
            *("losses", "never again", "again: median s", "again: largest s"),
        ),
        rows,
        "From the first frame of a trial to the first map, and from each loss to the next map, in the video's time.",
    )


def _end_point_table(counted: _Counted) -> ResultTable:
    """The numbers of Fig. 9."""
    rows: list[list[Cell]] = []
    for sequence in (s for s in counted.spec.sequences if s.returns_to_start):
        row: list[Cell] = [sequence.name]
        for variant in counted.spec.variant_names:
            trials = [r for r in counted.of(variant) if r.sequence == sequence.name]
            errors = [r.end_point_error_m for r in trials if r.end_point_error_m is not None and not counted.failed(r)]
            row += [_median(errors), _mark(counted.failures(trials), len(trials))]
        rows.append(row)
    columns = [c for v in counted.spec.variant_names for c in (f"{v} m", f"{v} failed")]
    return ResultTable(
        "figure_9_end_point",
        "End-point error (Fig. 9)",
        ("sequence", *columns),
        rows,
        "RMS distance between the trajectory laid upon the truth by its start and by its end (Engel et al. 2016); "
        "median of the trials that did not fail.",
    )


def _median(values: Sequence[float]) -> float | None:
    return statistics.median(values) if values else None
