"""Several runs side by side: their trajectories over each other, every frame of each, and one table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dualslam.core.geometry import sim3
from dualslam.core.types import Failure, FloatArray, FrameStatus
from dualslam.report.canvas import Canvas
from dualslam.report.markup import Markup, document, join, number, number_row, stretched, table, tag
from dualslam.report.page import flattened, headline
from dualslam.report.placement import Placed, align, extent, plane_from_above, position_errors
from dualslam.report.run_data import PosedRows, RunData, read_run
from dualslam.report.statuses import MEANING, WITHOUT_POSE, count, span, stretches
from dualslam.report.timeline import curve, frame_ticks, lane, lane_values

N_STYLES = 6
"""Ways of drawing a run: colour, dash and width each differ."""
# How high a status stands in its strip: it can be identified without its colour.
_HEIGHTS: dict[FrameStatus, float] = {
    FrameStatus.TRACKED: 1.0,
    FrameStatus.RECOVERED: 0.75,
    FrameStatus.BYPASSED: 0.55,
    FrameStatus.INITIALISING: 0.3,
    FrameStatus.LOST: 0.15,
    FrameStatus.DROPPED: 0.15,
    FrameStatus.UNREADABLE: 0.15,
}
Measure = tuple[str, Callable[[dict[str, Any]], str]]


def comparison_page(runs: Sequence[RunData | str | Path]) -> str:
    """Return a page for several runs, or for the runs in several folders.

    Raises `InputError` if a folder cannot be read as a run's (`read_run`).
    """
    read = [run if isinstance(run, RunData) else read_run(run) for run in runs]
    names = run_names(read)
    title = ", ".join(names)
    leads = [tag("li", tag("b", name), f": {headline(run)}") for name, run in zip(names, read, strict=True)]
    numbers, *rows = comparison_table(read)
    body = [
        tag("header", tag("h1", "Runs compared"), tag("ul", leads)),
        tag("section", tag("h2", "Trajectories"), _overlay(read, names)),
        tag("section", tag("h2", "Every frame"), _strips(read, names)),
        _errors(read, names),
        tag("section", tag("h2", "Numbers"), _side_by_side(numbers, rows)),
        tag("section", tag("h2", "Configuration"), _config_table(read, names)),
    ]
    return document(f"{title} - dualslam comparison", body)


def comparison_table(runs: Sequence[RunData]) -> list[list[str]]:
    """Return the numbers of several runs: a head row, then one row for each measure."""
    rows = [["", *run_names(runs)], ["sequence", *(str(run.summary.get("sequence", "-")) for run in runs)]]
    for name, value in MEASURES:
        rows.append([name, *(value(run.summary) for run in runs)])
    return rows


def run_names(runs: Sequence[RunData]) -> list[str]:
    """Return the folders' names, with as many parents as it takes to tell them apart."""
    paths = [run.path.resolve() for run in runs]
    names = distinct_names(paths)
    return names if len(set(names)) == len(names) else [f"{i} {run.name}" for i, run in enumerate(runs, 1)]


def distinct_names(paths: Sequence[Path]) -> list[str]:
    """Return the last parts of paths, as many as it takes to tell the paths apart; the same only for the same path."""
    longest = max(len(path.parts) for path in paths)
    names: list[str] = []
    for depth in range(1, longest + 1):
        names = ["/".join(path.parts[-depth:]) for path in paths]
        if len(set(names)) == len(names):
            break
    return names


def _plain(key: str) -> Callable[[dict[str, Any]], str]:
    return lambda s: str(s.get(key, "-"))


def _with_unit(unit: str, *keys: str) -> Callable[[dict[str, Any]], str]:
    def shown(s: dict[str, Any]) -> str:
        value: Any = s
        for key in keys:
            value = (value or {}).get(key)
        return "-" if value is None else f"{number(value)} {unit}"

    return shown


def _median_recovery(s: dict[str, Any]) -> str:
    seconds = s.get("recovery_s") or []
    return f"{number(float(np.median(seconds)))} s" if seconds else "-"


MEASURES: tuple[Measure, ...] = (
    ("frames", _plain("frames")),
    ("coverage", lambda s: f"{100 * s.get('coverage', 0):.1f} %"),
    ("verdict", lambda s: str((s.get("verdict") or {}).get("level", "-"))),
    ("failures", _plain("failures")),
    ("recoveries", _plain("recoveries")),
    ("recovery time (median)", _median_recovery),
    ("relocalisations", _plain("relocalised")),
    ("loops closed", _plain("loops")),
    ("maps merged", _plain("merges")),
    ("submaps", _plain("submaps")),
    ("keyframes", _plain("keyframes")),
    ("landmarks", _plain("landmarks")),
    ("ATE", _with_unit("m", "ate_rmse_m")),
    ("rotation error over 1 s", _with_unit("deg", "rpe", "rotation_deg_median")),
    ("translation error over 1 s", _with_unit("%", "rpe", "translation_pct_median")),
    ("latency, median", _with_unit("ms", "latency_ms", "median")),
    ("latency, 95 %", _with_unit("ms", "latency_ms", "p95")),
    ("CPU a frame", _with_unit("ms", "cpu_ms_per_frame")),
    ("speed", _with_unit("fps", "fps")),
    ("peak memory", _with_unit("MB", "peak_rss_mb")),
    ("seed", _plain("seed")),
    ("interrupted", lambda s: "yes" if s.get("interrupted") else "no"),
)


# --- trajectories


@dataclass(frozen=True, slots=True, eq=False)
class _Overlay:
    """Main maps in one frame, by the number of their run; those that could not be brought there are left out."""

    placed: dict[int, Placed]
    truth: FloatArray
    down: FloatArray
    note: str


def _overlay(runs: Sequence[RunData], names: Sequence[str]) -> Markup:
    """Draw the main maps over each other: on the truth, or on the first run's map where there is none."""
    overlay = _bring_together(runs)
    drawn = [p.xyz for p in overlay.placed.values()]
    if not drawn:
        return tag("p", "None of the runs has a map.", cls="empty")
    axes, view = plane_from_above(np.concatenate([*drawn, overlay.truth]), overlay.down)
    canvas = Canvas.around(*extent([xyz @ axes.T for xyz in (*drawn, overlay.truth)]))
    shapes = [canvas.line(overlay.truth @ axes.T, "truth", "true path")] if len(overlay.truth) else []
    for i, placed in overlay.placed.items():
        broken = np.diff(placed.row, prepend=placed.row[0]) > 1
        shapes += [
            canvas.line(placed.xyz[piece.start : piece.stop] @ axes.T, f"way run{i % N_STYLES}", names[i])
            for piece in stretches(np.cumsum(broken).tolist())
        ]
    keys = [tag("li", _sample(f"way run{i % N_STYLES}"), f" {names[i]}") for i in overlay.placed]
    if len(overlay.truth):
        keys.append(tag("li", _sample("truth"), " true path"))
    missing = [names[i] for i in range(len(runs)) if i not in overlay.placed]
    note = overlay.note + (f" Not drawn, as nothing places it here: {', '.join(missing)}." if missing else "")
    unit = "m" if len(overlay.truth) else ""
    drawing = canvas.draw(
        shapes, canvas.scale_bar(unit, np.concatenate(drawn) @ axes.T), f"Trajectories of {len(drawn)} runs from above"
    )
    caption = tag("figcaption", tag("ul", keys, cls="legend"), tag("p", f"{view[0].upper()}{view[1:]}. {note}"))
    return tag("figure", drawing, caption)


def _bring_together(runs: Sequence[RunData]) -> _Overlay:
    """Align each main map to the true path of its own run; without truth, to the first map by its frames' indices."""
    with_truth = [i for i, run in enumerate(runs) if len(run.truth) and len(run.main)]
    placed: dict[int, Placed] = {}
    if with_truth:
        sequences = {runs[i].summary.get("sequence") for i in with_truth}
        for i in with_truth:
            _place(placed, i, runs[i].main, runs[i].truth)
        longest = max(with_truth, key=lambda i: len(runs[i].truth))
        note = "Each main map is aligned to the truth by one similarity."
        if len(sequences) > 1:
            note += " The runs are of different sequences: each is drawn in the truth of its own."
        return _Overlay(placed, runs[longest].truth.xyz, runs[longest].truth.T_map_cam[:, :3, 1].mean(axis=0), note)
    first = next((i for i, run in enumerate(runs) if len(run.main)), None)
    if first is None:
        return _Overlay({}, np.zeros((0, 3)), np.zeros(3), "")
    reference = runs[first]
    for i, run in enumerate(runs):
        if not len(run.main) or run.summary.get("sequence") != reference.summary.get("sequence"):
            continue
        _place(placed, i, run.main, _on_rows_of(reference, run), identity=i == first)
    note = "No ground truth: each main map is aligned to the first one's by one similarity."
    return _Overlay(placed, np.zeros((0, 3)), reference.main.T_map_cam[:, :3, 1].mean(axis=0), note)


def _place(placed: dict[int, Placed], i: int, posed: PosedRows, truth: PosedRows, identity: bool = False) -> None:
    S = np.eye(4) if identity else align(posed, truth)
    if not isinstance(S, Failure):
        placed[i] = Placed(None, posed.row, sim3.act(S, posed.xyz), np.full(len(posed), np.nan))


def _on_rows_of(reference: RunData, run: RunData) -> PosedRows:
    """Return the reference's poses under the rows that the same frames have in another run."""
    row_of = run.row_of
    pairs = [(row_of.get(reference.rows[row].index), k) for k, row in enumerate(reference.main.row.tolist())]
    common = [(row, k) for row, k in pairs if row is not None]
    chosen = np.array([k for _, k in common], np.int64)
    return PosedRows(np.array([row for row, _ in common], np.int64), reference.main.T_map_cam[chosen])


# --- frames and numbers


def _errors(runs: Sequence[RunData], names: Sequence[str]) -> Markup | None:
    """Draw each run's position error over its frames, all to one scale; None where no run has a truth."""
    errors = [position_errors(run) for run in runs]
    known = [error for error in errors if np.isfinite(error).any()]
    if not known:
        return None
    top = max(float(np.nanmax(error)) for error in known)
    lanes = []
    for run, name, error in zip(runs, names, errors, strict=True):
        svg = stretched(len(error), 100, curve(error, max(top, 1e-12), "error"), f"Position error of {name}")
        seconds = abs(run.rows[-1].timestamp_s - run.rows[0].timestamp_s) if run.rows else 0.0
        note = "no ground truth" if not np.isfinite(error).any() else f"over {number(seconds)} s"
        lanes.append(lane(name, note, svg, [*lane_values(f"{number(top)} m", "0")], "error"))
    lanes.append(lane("frame", "", tag("div", cls="empty-lane"), frame_ticks([r.index for r in runs[0].rows]), "axis"))
    words = "Distance from the truth after alignment, each map by itself; all runs to one scale."
    return tag("section", tag("h2", "Error over time"), tag("p", words), tag("div", lanes, cls="lanes"))


def _strips(runs: Sequence[RunData], names: Sequence[str]) -> Markup:
    found = {row.status for run in runs for row in run.rows}
    indices = [row.index for run in runs for row in run.rows]
    first, last = min(indices, default=0), max(indices, default=0)
    lanes = [_strip(run, name, first, last + 1) for name, run in zip(names, runs, strict=True)]
    keys = [
        tag("li", _strip_sample(status), f" {status}: {MEANING[status]}") for status in FrameStatus if status in found
    ]
    return join([tag("div", lanes, cls="lanes strips"), tag("ul", keys, cls="legend")])


def _strip(run: RunData, name: str, first: int, stop: int) -> Markup:
    """Draw the frames of a run over the indices of all runs: the same frame stands at the same place in each strip."""
    status = [row.status for row in run.rows]
    steps = np.abs(np.diff([row.index for row in run.rows]))
    stride = int(np.median(steps)) if len(steps) else 1
    blocks = []
    for piece in stretches(status):
        value, height = status[piece.start], _HEIGHTS[status[piece.start]]
        ends = sorted((run.rows[piece.start].index, run.rows[piece.stop - 1].index))
        title = tag("title", f"{span(*ends)}: {value}")
        place = {"x": ends[0] - first, "y": f"{1 - height:.2f}", "width": ends[1] - ends[0] + stride}
        blocks.append(tag("rect", title, **place, height=f"{height:.2f}", cls=f"st-{value}"))
    unposed = sum(run.count(s) for s in WITHOUT_POSE)
    svg = stretched(max(stop - first, 1), 1, blocks, f"Frames of {name}")
    head = tag("div", tag("b", name), " ", tag("small", f"{unposed} of {count(len(status), 'frame')} without a pose"))
    return tag("div", tag("div", head, cls="lane-name"), tag("div", svg, cls="lane-body"), cls="lane")


def _strip_sample(status: FrameStatus) -> Markup:
    height = 14 * _HEIGHTS[status]
    rect = tag("rect", x=4, y=14 - height, width=22, height=height, cls=f"st-{status}")
    return tag("svg", rect, viewBox="0 0 30 14", aria_hidden="true")


def _config_table(runs: Sequence[RunData], names: Sequence[str]) -> Markup:
    flat = [dict(flattened(run.config)) for run in runs]
    fields = list(dict.fromkeys(name for config in flat for name in config))
    rows = [
        [name, *(str(config.get(name, "-")) for config in flat)]
        for name in fields
        if len({str(config.get(name, "-")) for config in flat}) > 1
    ]
    if not rows:
        return tag("p", "All runs have the same configuration.", cls="empty")
    return _side_by_side(("", *names), rows)


def _side_by_side(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> Markup:
    whole = table(heads, [number_row(row[0], row[1:]) for row in rows], "plain beside")
    return tag("div", whole, cls="scroll", tabindex=0, role="region", aria_label="table, scrolls sideways")


def _sample(cls: str) -> Markup:
    return tag("svg", tag("path", cls=cls, d="M2 7h26"), viewBox="0 0 30 14", aria_hidden="true")
