"""Tables of recovery: Table III of the paper, and Eq. (1) against the observed rates."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from dualslam.lab.bench.record import Breakage, TrialRecord
from dualslam.lab.bench.spec import BenchSpec
from dualslam.lab.bench.table import Cell, ResultTable
from dualslam.lab.metrics.statistics import wilson_interval


@dataclass(frozen=True, slots=True)
class AttemptCount:
    """How often the attempt of this number was made (all before it having failed), and how often it succeeded."""

    tried: int
    succeeded: int

    @property
    def failure_rate(self) -> float | None:
        """Probability that it fails, given that those before it failed."""
        return 1 - self.succeeded / self.tried if self.tried else None


def count_attempts(breakages: Sequence[Breakage]) -> list[AttemptCount]:
    """Return the count of each attempt, the first one first."""
    deepest = max((b.attempts for b in breakages), default=0)
    return [
        AttemptCount(sum(b.attempts >= a for b in breakages), sum(b.succeeded_at == a for b in breakages))
        for a in range(1, deepest + 1)
    ]


def recovery_table(spec: BenchSpec, records: Sequence[TrialRecord]) -> ResultTable:
    """Table III."""
    rows: list[list[Cell]] = []
    for variant in spec.variant_names:
        trials = [r for r in records if r.variant == variant]
        broken = [b for r in trials for b in r.breakages]
        recovered = [b for b in broken if b.recovered]
        needing = [r for r in trials if r.breakages]
        whole = [r for r in needing if all(b.recovered for b in r.breakages)]
        seconds = [b.recovery_s for b in recovered if b.recovery_s is not None]
        head: list[Cell] = [variant, len(trials), len(needing), len(whole), len(broken), len(recovered)]
        head += [sum(b.relocalised for b in broken), sum(b.merged for b in broken)]
        head += [sum(b.retries for b in broken), sum(b.linked_by_retry for b in broken)]
        tail: list[Cell] = [
            statistics.mean(seconds) if seconds else None,
            statistics.median(seconds) if seconds else None,
            max(seconds, default=None),
        ]
        attempts = count_attempts(broken)
        for number, count in enumerate(attempts, 1):
            wilson = wilson_interval(count.succeeded, count.tried)
            share = 100 * count.succeeded / count.tried if count.tried else None
            cells: list[Cell] = [number, count.tried, count.succeeded, share, 100 * wilson.low, 100 * wilson.high]
            rows.append(
                [*(head if number == 1 else [None] * len(head)), *cells, *(tail if number == 1 else [None] * 3)]
            )
        if not attempts:
            rows.append([*head, *[None] * 6, *tail])
    return ResultTable(
        "table_3_recoveries",
        "Table III: recoveries",
        (
            *("variant", "trials", "with a loss", "all recovered", "losses", "recovered"),
            *("seen again", "merged later", "retries", "linked by a retry"),
            *("attempt", "made", "succeeded", "success %", "low %", "high %", "mean s", "median s", "longest s"),
        ),
        rows,
        "An attempt is made if all before it failed, so its success is conditional on that. Attempts of a repeated "
        "reverse tracking are retries, counted separately. Wilson's 95 % intervals. Seconds are wall time of the "
        "recoveries that succeeded, on the machine of the bench.",
    )


def redundancy_table(spec: BenchSpec, records: Sequence[TrialRecord]) -> ResultTable:
    """Eq. (1), Pr(Failure) = p0 (p_r)^n, against what was observed."""
    rows: list[list[Cell]] = []
    for variant in spec.variant_names:
        trials = [r for r in records if r.variant == variant]
        attempts = count_attempts([b for r in trials for b in r.breakages])
        rates = [a.failure_rate for a in attempts]
        needing = sum(bool(r.breakages) for r in trials)
        unrecovered = sum(any(not b.recovered for b in r.breakages) for r in trials)
        p0 = needing / len(trials) if trials else None
        independent = conditional = None
        if p0 is not None and rates and all(rate is not None for rate in rates):
            known = [rate for rate in rates if rate is not None]
            independent = p0 * known[0] ** len(known)
            conditional = p0 * math.prod(known)
        elif p0 is not None:
            independent = conditional = p0  # no attempt was made: every loss stays one
        observed = unrecovered / len(trials) if trials else None
        wilson = wilson_interval(unrecovered, len(trials))
        given = ", ".join("-" if rate is None else f"{rate:.3g}" for rate in rates)
        rows.append(
            [variant, len(trials), p0, given or "-", independent, conditional, observed, wilson.low, wilson.high]
        )
    return ResultTable(
        "equation_1",
        "Eq. (1) against what was observed",
        (
            *("variant", "trials", "p0", "p_r of each attempt, given that those before it failed"),
            *("p0 p_r^n as if independent", "p0 times these", "observed", "low", "high"),
        ),
        rows,
        "p0: share of the trials in which a map was lost. Observed: share of the trials in which a lost map stayed "
        "lost, retries and all, with Wilson's 95 % interval. Eq. (1) takes attempts for independent, with the first "
        "one's p_r. A trial may lose more than one map, so that the second figure need not be the third.",
    )
