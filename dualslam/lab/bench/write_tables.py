"""Tables onto the disk: all of them in one Markdown page, and each as CSV; every trial as a row."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from dualslam.io.atomic import write_text
from dualslam.lab.bench.record import TrialRecord, judge
from dualslam.lab.bench.spec import BenchSpec
from dualslam.lab.bench.table import ResultTable

TABLES = "tables.md"
FOLDER = "tables"

_COLUMNS = (
    *("sequence", "condition", "variant", "trial", "start", "failed", "outcome", "coverage", "initialised_at"),
    *("initialised_after_s", "ate_m", "path_m", "end_point_error_m", "losses", "recovered", "links", "wall_s", "cpu_s"),
    "error",
)


def write_tables(
    spec: BenchSpec, tables: Sequence[ResultTable], records: Sequence[TrialRecord], out: Path, command: str
) -> list[Path]:
    """Write ``tables.md``, ``tables/*.csv`` and ``*.tex``, and ``tables/trials.csv``; return what was written.

    Parameters
    ----------
    spec : BenchSpec
    tables : sequence of ResultTable
    records : sequence of TrialRecord
    out : Path
    command : str
        What makes the same tables again.
    """
    page, folder = out / TABLES, out / FOLDER
    heading = f"## {spec.name}\n\n`{command}`: {len(records)} trials of the {spec.half} half, seed {spec.seed}.\n\n"
    write_text(page, heading + "\n".join(table.markdown() for table in tables))
    files = [page]
    for table in tables:
        for ending, text in (("csv", table.csv()), ("tex", table.latex())):
            files.append(folder / f"{table.name}.{ending}")
            write_text(files[-1], text)
    files.append(folder / "trials.csv")
    write_text(files[-1], _trials_csv(spec, records))
    return files


def _trials_csv(spec: BenchSpec, records: Sequence[TrialRecord]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for r in records:
        verdict = judge(r, spec.thresholds)
        recovered = sum(b.recovered for b in r.breakages)
        measures = (r.ate_m, r.path_m, r.end_point_error_m)
        row = [r.sequence, r.condition, r.variant, r.number, r.start, verdict, r.outcome, r.coverage, r.initialised_at]
        row += [r.initialised_after_s, *measures, len(r.breakages), recovered, len(r.links), r.wall_s, r.cpu_s, r.error]
        writer.writerow(["" if cell is None else cell for cell in row])
    return text.getvalue()
