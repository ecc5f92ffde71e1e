"""The figures of a bench, as PNG and PDF: initialisation delay, frames' statuses, failure rates, end-point errors.

They are drawn with matplotlib (extra `report`); what they show is handed over as plain numbers and letters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

# Okabe and Ito's colours, which colour-blind people can distinguish; words beside them say the same.
_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#999999", "#F0E442")
_STATUS: tuple[tuple[str, str, str], ...] = (
    ("", "no frame", "#FFFFFF"),
    ("TI", "in the main map", "#009E73"),
    ("R", "recovered", "#E69F00"),
    ("B", "by-passed", "#CC79A7"),
    ("trb", "in another map", "#56B4E9"),
    ("i", "no map", "#DDDDDD"),
    ("lL", "lost", "#D55E00"),
    ("du", "dropped or unreadable", "#444444"),
)
_DPI = 130


def draw_rates(path: Path, rates: Mapping[str, Mapping[str, tuple[float, float, float]]]) -> None:
    """Draw failure rates with their intervals.

    `rates` (mapping of str to mapping of str to (float, float, float)): by what was counted over, then by variant:
    percent, and the ends of its interval.
    """
    variants = list(dict.fromkeys(variant for row in rates.values() for variant in row))
    figure, (axes,) = _figure(1, (max(5.0, 1.6 * len(rates) + 2), 4.0))
    width = 0.8 / max(len(variants), 1)
    for i, variant in enumerate(variants):
        percent, low, high = np.array([row[variant] for row in rates.values()]).T
        x = np.arange(len(rates)) + (i - (len(variants) - 1) / 2) * width
        axes.bar(x, percent, 0.92 * width, color=_COLOURS[i % len(_COLOURS)], label=variant)
        axes.errorbar(
            x, percent, yerr=np.maximum([percent - low, high - percent], 0), fmt="none", ecolor="black", capsize=3, lw=1
        )
    axes.set_xticks(range(len(rates)), [name.replace(": ", ":\n") for name in rates])
    axes.set_ylim(0, 100)
    axes.set_ylabel("failed trials, %")
    axes.legend(frameon=False)
    _save(figure, path)


def draw_delays(path: Path, delays_s: Mapping[str, Sequence[float | None]]) -> None:
    """Draw how long the trials took to their first map (Fig. 6): the share of them that had one after so long.

    `delays_s`: by variant, one for each trial; None where it never had a map: its curve ends below 100 %.
    """
    figure, (axes,) = _figure(1, (7.0, 3.6))
    longest = max((d for row in delays_s.values() for d in row if d is not None), default=1.0)
    for i, (variant, row) in enumerate(delays_s.items()):
        had = sorted(d for d in row if d is not None)
        share = 100 * np.arange(len(had) + 1) / max(len(row), 1)
        # Lines of different widths, so that equal curves do not hide each other.
        width = 1.5 + 1.2 * (len(delays_s) - 1 - i)
        steps = np.r_[0.0, had, 1.05 * longest], np.r_[share, share[-1]]
        axes.step(*steps, where="post", color=_COLOURS[i % len(_COLOURS)], lw=width, label=variant)
    axes.set_ylim(0, 103)
    axes.set_xlabel("first map after, s of video")
    axes.set_ylabel("trials, %")
    axes.legend(frameon=False, loc="lower right")
    _save(figure, path)


def draw_statuses(path: Path, title: str, statuses: Mapping[str, Mapping[str, Sequence[str]]]) -> None:
    """Draw the status of every frame of every trial (Fig. 7): trials side by side, frames upwards.

    `statuses`: by condition, then by variant: a letter for each frame of each trial, as in the lines of a bench.
    """
    variants = list(dict.fromkeys(variant for row in statuses.values() for variant in row))
    rows, columns = len(statuses), len(variants)
    figure = Figure(figsize=(2.2 * columns + 0.8, 1.7 * rows + 1.2), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharex="row")
    colours = ListedColormap([colour for _, _, colour in _STATUS])
    norm = BoundaryNorm(np.arange(len(_STATUS) + 1) - 0.5, len(_STATUS))
    for i, (condition, by_variant) in enumerate(statuses.items()):
        for j, variant in enumerate(variants):
            axes: Axes = grid[i, j]
            axes.imshow(
                _codes(by_variant[variant]),
                cmap=colours,
                norm=norm,
                aspect="auto",
                origin="lower",
                interpolation="none",
            )
            axes.set_xticks([])
            if i == 0:
                axes.set_title(variant, fontsize=9)
            if j == 0:
                axes.set_ylabel(f"{condition}\nframe", fontsize=8)
            axes.tick_params(labelsize=7)
    figure.suptitle(title, fontsize=10)
    handles = [Patch(facecolor=colour, edgecolor="#888888", label=name) for _, name, colour in _STATUS[1:]]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=7, frameon=False)
    _save(figure, path)


def draw_end_points(path: Path, errors_m: Mapping[str, Mapping[str, Sequence[float | None]]]) -> None:
    """Draw the end-point error of every trial (Fig. 9): sequences across, trials upwards; failed ones are crossed.

    `errors_m`: by variant, then by sequence; None for a trial that failed.
    """
    figure, panels = _figure(
        len(errors_m), (max(5.0, 0.35 * len(next(iter(errors_m.values()))) + 3), 1.9 * len(errors_m))
    )
    known = [e for by_sequence in errors_m.values() for row in by_sequence.values() for e in row if e is not None]
    top = float(np.percentile(known, 95)) if known else 1.0
    colours = mpl.colormaps["viridis"].with_extremes(bad="#BBBBBB")
    for axes, (variant, by_sequence) in zip(panels, errors_m.items(), strict=True):
        n = max(len(row) for row in by_sequence.values())
        values = np.full((n, len(by_sequence)), np.nan)
        for j, row in enumerate(by_sequence.values()):
            values[: len(row), j] = [np.nan if e is None else e for e in row]
        image = axes.imshow(values, cmap=colours, vmin=0, vmax=top, aspect="auto", origin="lower", interpolation="none")
        for i, j in np.argwhere(np.isnan(values)):
            axes.plot(j, i, "x", color="#D55E00", ms=4)
        axes.set_xticks(range(len(by_sequence)), list(by_sequence), rotation=90, fontsize=6)
        axes.set_ylabel(f"{variant}\ntrial", fontsize=8)
        figure.colorbar(image, ax=axes, label="m")
    _save(figure, path)


def _codes(trials: Sequence[str]) -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
    """Return the status of each frame (upwards) of each trial (across) as rows of `_STATUS`."""
    code = {letter: k for k, (letters, _, _) in enumerate(_STATUS) for letter in letters}
    codes = np.zeros((max((len(trial) for trial in trials), default=0) or 1, max(len(trials), 1)), np.int64)
    for j, trial in enumerate(trials):
        codes[: len(trial), j] = [code[letter] for letter in trial]
    return codes


def _figure(n_panels: int, size: tuple[float, float]) -> tuple[Figure, list[Axes]]:
    # Not by pyplot, which keeps state of its own and looks for a screen.
    figure = Figure(figsize=size, layout="constrained")
    return figure, list(figure.subplots(n_panels, 1, squeeze=False)[:, 0])


def _save(figure: Figure, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=_DPI, metadata={"Software": None})
    # Without a date, so that the same numbers give the same file.
    figure.savefig(path.with_suffix(".pdf"), metadata={"CreationDate": None})
