"""`dualslam bench`: every sequence in every condition with every variant, and the tables of the paper from it."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from dualslam.cli import logs
from dualslam.cli.bench_figures import draw_figures
from dualslam.core.errors import InputError
from dualslam.lab.bench.cluster import run_on_cluster
from dualslam.lab.bench.plan import plan_trials
from dualslam.lab.bench.pool import run_in_processes
from dualslam.lab.bench.record import TrialRecord, judge
from dualslam.lab.bench.run import Executor, run_bench
from dualslam.lab.bench.spec import BenchSpec, Half, load_spec
from dualslam.lab.bench.tables import bench_tables
from dualslam.lab.bench.verdict_tables import verdict_tables
from dualslam.lab.bench.write_tables import TABLES, write_tables
from dualslam.run.bench_trial import describe_source, run_trial


def execute(args: argparse.Namespace) -> int:
    """Run what is not done yet, write the tables, and print them."""
    spec = load_spec(args.spec).only(args.only).parts(args.part).with_trials(args.trials, args.half)
    if args.data is not None and not args.data.is_dir():
        raise InputError(f"--data {args.data} is no folder; give the one that holds the sequences.")
    trials = plan_trials(spec, partial(describe_source, data=args.data))
    out: Path = args.out if args.out is not None else Path("runs") / _folder_name(spec)
    logs.release()
    with _progress(spec, args.quiet) as on_trial:
        records = run_bench(spec, trials, out, _executor(args, out), on_trial, args.limit)
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


@contextmanager
def _progress(spec: BenchSpec, quiet: bool) -> Iterator[Callable[[TrialRecord, int, int], None] | None]:
    """Show a bar on stderr if a person watches; a line for each trial if not."""
    if quiet:
        yield None
        return
    if not sys.stderr.isatty():
        yield lambda record, n_done, n: print(f"{n_done}/{n} {_line(spec, record)}", file=sys.stderr, flush=True)
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(spec.name, total=None)
        yield lambda record, n_done, n: bar.update(task, completed=n_done, total=n, description=_line(spec, record))


def _line(spec: BenchSpec, record: TrialRecord) -> str:
    failed = judge(record, spec.thresholds)
    return f"{record.key}: {'good' if failed is None else failed}, coverage {100 * record.coverage:.0f} %"
