"""`dualslam bench`: every sequence in every condition with every variant, and the paper's tables and figures of it."""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from dualslam.cli import logs
from dualslam.core.errors import InputError, how_to_install
from dualslam.lab.bench.cluster import run_on_cluster
from dualslam.lab.bench.plan import plan_trials
from dualslam.lab.bench.pool import run_in_processes
from dualslam.lab.bench.record import TrialRecord, judge
from dualslam.lab.bench.run import Executor, run_bench
from dualslam.lab.bench.spec import BenchSpec, Half, load_spec
from dualslam.lab.bench.table import ResultTable
from dualslam.lab.bench.tables import bench_tables
from dualslam.lab.bench.verdict_tables import verdict_tables
from dualslam.lab.bench.write_tables import TABLES, write_tables
from dualslam.run.bench_trial import describe_source, run_trial

log = logging.getLogger(__name__)
FOLDER = "figures"


def execute(args: argparse.Namespace) -> int:
    """Run what is not done yet, write the tables, and print them."""
    spec = load_spec(args.spec).only(args.only).parts(args.part).with_trials(args.trials, args.half)
    if args.data is not None and not args.data.is_dir():
        raise InputError(f"--data {args.data} is no folder; give the one that holds the sequences.")
    trials = plan_trials(spec, partial(describe_source, data=args.data))
    out: Path = args.out if args.out is not None else Path("runs") / _folder_name(spec)
    logs.release()
    records = run_bench(
        spec, trials, out, _executor(args, out), None if args.quiet else partial(_say, spec), args.limit
    )
    tables = verdict_tables(spec, records) + bench_tables(spec, records)
    written = write_tables(spec, tables, records, out, command=_command(args))
    written += draw_figures(spec, tables, records, out)
    if not args.quiet:
        print((out / TABLES).read_text(encoding="utf-8"), end="")
        print(f"{len(records)} trials and {len(written)} files of tables and figures in {out}", flush=True)
    return 0


def _executor(args: argparse.Namespace, out: Path) -> Executor:
    run = partial(run_trial, out=str(out.resolve()))
    if args.scheduler is not None:
        return lambda trials: run_on_cluster(run, trials, args.scheduler)
    n_processes = args.jobs or os.cpu_count() or 1
    return lambda trials: run_in_processes(run, trials, n_processes)


def _folder_name(spec: BenchSpec) -> str:
    """Return a folder of its own for each half, so that no table mixes them."""
    return spec.name if spec.half is Half.REPORTING else f"{spec.name}_{spec.half}"


def _command(args: argparse.Namespace) -> str:
    """Return the command as another person would give it; how trials were spread does not matter to them."""
    words = ["dualslam bench", str(args.spec)]
    words += ["--data DIR"] if args.data is not None else []
    words += [f"--only {name}" for name in args.only]
    words += [f"--part {name}" for name in args.part]
    words += [f"--trials {args.trials}"] if args.trials is not None else []
    words += [f"--half {args.half}"] if args.half is not None else []
    return " ".join(words)


def _say(spec: BenchSpec, record: TrialRecord, n_done: int, n: int) -> None:
    """Write a line for a trial that is done."""
    failed = judge(record, spec.thresholds)
    outcome = f"{'good' if failed is None else failed}, coverage {100 * record.coverage:.0f} %"
    print(f"{n_done}/{n} {record.key}: {outcome}", file=sys.stderr, flush=True)


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
