"""From the lines of a bench to its figures, where matplotlib is installed."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from dualslam.core.extras import how_to_install
from dualslam.lab.bench.record import TrialRecord, judge
from dualslam.lab.bench.spec import BenchSpec
from dualslam.lab.bench.table import ResultTable

log = logging.getLogger(__name__)

FOLDER = "figures"


def draw_figures(
    spec: BenchSpec, tables: Sequence[ResultTable], records: Sequence[TrialRecord], out: Path
) -> list[Path]:
    """Draw the figures into ``figures/``; return what was written: nothing without matplotlib, and the log says so."""
    if find_spec("matplotlib") is None:
        log.warning("no figures: they need matplotlib (%s)", how_to_install("report"))
        return []
    from dualslam.report.bench_figures import draw_delays, draw_end_points, draw_rates, draw_statuses

    folder = out / FOLDER
    files = [folder / "table_2_failures.png", folder / "figure_6_initialisation.png"]
    draw_rates(files[0], _rates(tables))
    by_variant = {v: [r for r in records if r.variant == v] for v in spec.variant_names}
    draw_delays(files[1], {v: [r.initialised_after_s for r in trials] for v, trials in by_variant.items()})
    tried = {r.sequence for r in records}  # conditions may leave a sequence out
    sequences = [s for s in spec.sequences if s.name in tried]
    for sequence in sequences:
        files.append(folder / f"figure_7_{sequence.name}.png")
        draw_statuses(files[-1], sequence.name, _statuses(spec, records, sequence.name))
    returning = [s.name for s in sequences if s.returns_to_start]
    if returning:
        files.append(folder / "figure_9_end_point.png")
        errors = {v: {s: _errors(spec, trials, s) for s in returning} for v, trials in by_variant.items()}
        draw_end_points(files[-1], errors)
    return [file.with_suffix(ending) for file in files for ending in (".png", ".pdf")]


def _rates(tables: Sequence[ResultTable]) -> dict[str, dict[str, tuple[float, float, float]]]:
    """Return percent and the ends of the interval."""
    table = next(t for t in tables if t.name == "table_2_failures")
    rates: dict[str, dict[str, tuple[float, float, float]]] = {}
    for row in table.rows:
        cells = dict(zip(table.columns, row, strict=True))
        percent, low, high = (float(cells[name] or 0) for name in ("rate %", "rate low %", "rate high %"))
        rates.setdefault(str(cells["which trials"]), {})[str(cells["variant"])] = percent, low, high
    return rates


def _statuses(spec: BenchSpec, records: Sequence[TrialRecord], sequence: str) -> dict[str, dict[str, list[str]]]:
    here = [r for r in records if r.sequence == sequence]
    return {
        condition: {
            v: [r.status for r in here if (r.condition, r.variant) == (condition, v)] for v in spec.variant_names
        }
        for condition in dict.fromkeys(r.condition for r in here)
    }


def _errors(spec: BenchSpec, trials: Sequence[TrialRecord], sequence: str) -> list[float | None]:
    here = [r for r in trials if r.sequence == sequence]
    return [None if judge(r, spec.thresholds) is not None else r.end_point_error_m for r in here]
