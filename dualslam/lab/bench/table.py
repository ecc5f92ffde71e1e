"""A table that is written three times: for people (Markdown), for programs (CSV), and for papers (LaTeX)."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

Cell = str | int | float | None


@dataclass(frozen=True, slots=True)
class ResultTable:
    """Columns and rows.

    Attributes
    ----------
    name : str
        Of its file.
    title : str
    columns : tuple of str
    rows : sequence of sequences of Cell
        None: there is nothing to tell.
    note : str
        What the numbers are.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    rows: Sequence[Sequence[Cell]]
    note: str

    def markdown(self) -> str:
        """Return it with a heading and its note; numbers with three digits."""
        lines = [f"### {self.title}", "", _line(self.columns), "|" + "---|" * len(self.columns)]
        lines += [_line([_shown(cell) for cell in row]) for row in self.rows]
        return "\n".join([*lines, "", self.note, ""])

    def csv(self) -> str:
        """Return it with all digits, empty where there is nothing to tell."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows(["" if cell is None else cell for cell in row] for row in self.rows)
        return text.getvalue()

    def latex(self) -> str:
        """Return a ``tabular`` for LaTeX with the package booktabs; numbers with three digits, to the right."""
        numeric = [all(isinstance(row[i], int | float | None) for row in self.rows) for i in range(len(self.columns))]
        lines = [f"% {self.title}. {self.note}".replace("\n", " ")]
        lines += [rf"\begin{{tabular}}{{{''.join('r' if each else 'l' for each in numeric)}}}", r"\toprule"]
        lines += [_latex_line(self.columns), r"\midrule"]
        lines += [_latex_line([_shown(cell) for cell in row]) for row in self.rows]
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


_LATEX = str.maketrans(
    {c: f"\\{c}" for c in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | {"⊗": r"$\otimes$", "↷": r"$\curvearrowright$", "±": r"$\pm$", "≥": r"$\geq$", "≤": r"$\leq$"}
)


def _latex_line(cells: Sequence[str]) -> str:
    return " & ".join(cell.translate(_LATEX) for cell in cells) + r" \\"


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _shown(cell: Cell) -> str:
    if cell is None:
        return "-"
    if isinstance(cell, float):
        return f"{cell:.0f}" if abs(cell) >= 1000 else f"{cell:.3g}"
    return str(cell)
