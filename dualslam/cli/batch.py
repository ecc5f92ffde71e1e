"""Several sources for `dualslam run`: a run folder for each, and a table that names those that need a look."""

from __future__ import annotations

import argparse
import csv
import io
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from dualslam.cli.compare_command import table_text
from dualslam.core import exit_status
from dualslam.core.errors import DualSlamError, InputError
from dualslam.io.atomic import write_text
from dualslam.io.run_folder import SUMMARY
from dualslam.io.run_reading import read_summary
from dualslam.report.compare import distinct_names
from dualslam.run.judgement import MIN_COVERAGE

TABLE = "runs.csv"
COLUMNS = ("run", "frames", "coverage", "submaps", "verdict", "reasons")
FOR_ONE_SOURCE = ("replay", "live", "measurements")


def run_all(args: argparse.Namespace, run_one: Callable[[argparse.Namespace], int]) -> int:
    """Run on each of `args.sources` into a folder of its own below `args.out`; return the exit status of all.

    A source that cannot be read ends none of the others. Without --overwrite, runs that are there already are kept.
    """
    for name in FOR_ONE_SOURCE:
        if getattr(args, name) not in (None, []):
            raise InputError(f"--{name} belongs to one source: give one SOURCE with it.")
    outs = _folders(args.sources, Path(args.out))
    status, errors = exit_status.DONE, {}
    for i, (source, (name, out)) in enumerate(zip(args.sources, outs.items(), strict=True), 1):
        lead, ended = f"[{i}/{len(outs)}] {name}", _has_ended(out)
        if ended and not args.overwrite:
            _say(args, f"{lead}: kept, as it is there already")
            continue
        _say(args, lead)
        again = args.overwrite or ended is False
        try:
            one = run_one(argparse.Namespace(**vars(args) | {"sources": [source], "out": out, "overwrite": again}))
        except DualSlamError as error:
            errors[name], one = str(error), exit_status.BAD_INPUT
            print(f"dualslam: {name}: {error}", file=sys.stderr)
        status = max(status, one)
        if one == exit_status.INTERRUPTED:
            break
    _conclude(args, [_row(name, out, errors.get(name, "not run")) for name, out in outs.items()])
    return status


def _conclude(args: argparse.Namespace, rows: Sequence[dict[str, Any]]) -> None:
    """Print the table, and write it."""
    missing = [str(row["run"]) for row in rows if not _is_whole(row)]
    whole = f"{100 * MIN_COVERAGE:.0f} % of the frames in the main map, not doubtful"
    _say(args, table_text([list(COLUMNS), *([_worded(row[key]) for key in COLUMNS] for row in rows)]))
    _say(args, f"{len(rows) - len(missing)} of {len(rows)} are whole: {whole}")
    if missing:
        _say(args, f"look at: {', '.join(missing)}")
    file = Path(args.out) / TABLE
    write_text(file, _as_csv(rows))
    _say(args, f"table in {file}")


def _folders(sources: Sequence[str], parent: Path) -> dict[str, Path]:
    """Return a folder for each source, by its name: that of its file, with as many parents as it takes."""
    paths = [Path(source).absolute() for source in sources]
    names = distinct_names([path.with_suffix("") if path.is_file() else path for path in paths])
    if len(set(names)) < len(names):
        names = distinct_names(paths)
    if len(set(names)) < len(names):
        raise InputError(f"source {max(sources, key=sources.count)} is named twice.")
    return {name: parent / name for name in names}


def _has_ended(out: Path) -> bool | None:
    """Return whether a run went on to its end; None if there is none."""
    return not read_summary(out)["interrupted"] if (out / SUMMARY).exists() else None


def _row(name: str, out: Path, missing: str) -> dict[str, Any]:
    if not (out / SUMMARY).exists():
        return dict.fromkeys(COLUMNS, "") | {"run": name, "reasons": missing}
    summary = read_summary(out)
    verdict = summary.get("verdict") or {"level": "-", "reasons": []}  # of an earlier version
    reasons = ", ".join(reason["code"] for reason in verdict["reasons"])
    values = name, summary["frames"], summary["coverage"], summary["submaps"], verdict["level"], reasons
    return dict(zip(COLUMNS, values, strict=True))


def _is_whole(row: dict[str, Any]) -> bool:
    return bool(row["coverage"] != "" and row["coverage"] >= MIN_COVERAGE and row["verdict"] != "doubtful")


def _worded(value: Any) -> str:
    return f"{100 * value:.1f} %" if isinstance(value, float) else str(value)


def _as_csv(rows: Sequence[dict[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _say(args: argparse.Namespace, text: str) -> None:
    if not args.quiet:
        print(text, flush=True)
