"""`dualslam compare`: several runs side by side."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from dualslam.cli.configuration import check_free
from dualslam.io.atomic import write_text
from dualslam.report import RunData, comparison_page, comparison_table, read_run


def execute(args: argparse.Namespace) -> int:
    """Print a table of the runs' numbers, and write the page."""
    check_free(args.out, args.overwrite, "another with --out")
    present([read_run(path) for path in args.runs], args.out, args.quiet)
    return 0


def present(runs: Sequence[RunData], page: Path, quiet: bool) -> None:
    """Write the page of a comparison, and print its table."""
    write_text(page, comparison_page(runs))
    if not quiet:
        print(table_text(comparison_table(runs)))
        print(f"page in {page}", flush=True)


def table_text(rows: Sequence[Sequence[str]]) -> str:
    """Return rows of words as aligned columns, the first one to the left."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = []
    for row in rows:
        first, *rest = (
            cell.ljust(w) if i == 0 else cell.rjust(w) for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        )
        lines.append("  ".join([first, *rest]).rstrip())
    return "\n".join(lines)
