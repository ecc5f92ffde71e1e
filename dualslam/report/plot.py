"""The trajectory of a run from above, drawn with matplotlib (extra `report`) for notebooks and papers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dualslam.core.errors import InputError, OutputError
from dualslam.core.types import FloatArray, FrameStatus, IntArray
from dualslam.report.placement import Placed, place, plane_from_above
from dualslam.report.run_data import RunData

COLOURS = {FrameStatus.TRACKED: "#0072B2", FrameStatus.RECOVERED: "#009E73", FrameStatus.BYPASSED: "#E69F00"}
"""Okabe and Ito's, which colour-blind people distinguish."""
DPI = 120


def plot_run(run: RunData, path: str | Path | None = None) -> Figure:
    """Return the drawing of a run, and write it to a file if one is given.

    Raises `InputError`, `OutputError` if no frame has a pose, or the file cannot be written.
    """
    scene = place(run)
    if not scene.placed:
        raise InputError(f"{run.path}: no frame has a pose, so there is no trajectory to draw.")
    axes, view = plane_from_above(np.concatenate([p.xyz for p in scene.placed]), scene.down)
    figure = Figure(figsize=(7.0, 4.5), dpi=DPI, layout="constrained")
    ax = figure.subplots()
    if len(scene.truth_row):
        ax.plot(*_with_gaps(scene.truth_row, scene.truth_xyz @ axes.T).T, color="#444444", lw=0.8, label="truth")
    for placed in scene.placed:
        _draw(ax, run, placed, placed.xyz @ axes.T)
    ax.margins(0.15)
    ax.set_aspect("equal", adjustable="datalim")
    if len(scene.points):  # those far from the way do not make it small
        ax.plot(*(scene.points @ axes.T).T, ".", color="#999999", ms=1, zorder=0, scalex=False, scaley=False)
    unit = scene.unit or "map unit"
    ax.set_xlabel(f"right, {unit}")
    ax.set_ylabel(f"up on paper, {unit}")
    ax.set_title(f"{run.summary.get('sequence', run.name)}, {view.split(' (')[0]}", fontsize=10)
    figure.legend(loc="outside lower center", ncols=5, frameon=False, fontsize=8)
    if path is not None:
        try:
            figure.savefig(path)
        except (OSError, ValueError) as error:
            raise OutputError(f"{path} cannot be written: {error}.") from error
    return figure


def _draw(ax: Axes, run: RunData, placed: Placed, uv: FloatArray) -> None:
    """Draw a trajectory, one line for each status that occurs."""
    status = np.array([run.rows[i].status for i in placed.row.tolist()])
    whose = "" if placed.submap is None else f", submap {placed.submap} (not linked)"
    for each, colour in COLOURS.items():
        kept = status == each
        if kept.any():
            line = _with_gaps(placed.row[kept], uv[kept])
            ax.plot(*line.T, "-" if placed.submap is None else ":", color=colour, lw=1.6, label=f"{each}{whose}")


def _with_gaps(row: IntArray, uv: FloatArray) -> FloatArray:
    """Return points (N, 2) with NaN where frames are missing, so that no line bridges them."""
    breaks = np.flatnonzero(np.diff(row) > 1) + 1
    return np.insert(uv, breaks, np.nan, axis=0)
