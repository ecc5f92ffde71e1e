"""The run over time, every frame of it: status lanes, submaps, events, and the numbers that decide between them.

All lanes share one horizontal axis. They are SVG that stretches to the width of the page; words and marks are HTML over
it, so that they keep their size.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from dualslam.core.types import FloatArray, FrameStatus
from dualslam.report.canvas import ticks
from dualslam.report.markup import ROUNDING, Markup, coordinate, duration, number, stretched, tag
from dualslam.report.placement import position_errors
from dualslam.report.run_data import RunData
from dualslam.report.statuses import MEANING, count, span, stretches
from dualslam.report.top_view import failure_letter

MAX_COLUMNS = 900
"""Points along a curve: more than a screen has room for would only make the page heavy."""
MIN_LABEL_PERCENT = 3.0
_MARKS = {
    "initialised": ("○", "mark", "a map begins"),
    "reinitialised": ("○", "mark", "a new map begins"),
    "gap_relocalised": ("↺", "mark quiet", "found again"),
    "relocalised": ("↺", "mark good", "a place of the map is revisited, and the map continues"),
    "rolled_over": ("→", "mark quiet", "a full submap hands over to the next"),
    "linked": ("◆", "mark good", "two submaps are linked"),
    "relinked": ("◆", "mark good", "a link of unsure scale is measured again"),
    "loop_closed": ("◆", "mark good", "a loop is closed"),
    "merged": ("◆", "mark good", "two maps are joined by what both have seen"),
    "interrupted": ("■", "mark bad", "the run was interrupted"),
}


def timeline(run: RunData) -> Markup:
    """Return the section."""
    if not run.rows:
        return tag("p", "The source gave no frame.", cls="empty")
    lanes = [*_status_lanes(run), _submap_lane(run), _event_lane(run), _inlier_lane(run)]
    lanes += [each for each in (_error_lane(run), _latency_lane(run), _axis(run)) if each is not None]
    return tag("div", lanes, cls="lanes")


# --- lanes


def _status_lanes(run: RunData) -> list[Markup]:
    """One lane for each status that occurs: the place tells it, not the colour alone."""
    status = [row.status for row in run.rows]
    found = [s for s in FrameStatus if s in status]
    by_status: dict[FrameStatus, list[Markup]] = {s: [] for s in found}
    for stretch in stretches(status):
        value = status[stretch.start]
        frames = span(run.rows[stretch.start].index, run.rows[stretch.stop - 1].index)
        block = _block(stretch.start, len(stretch), f"{frames}: {value}", f"st-{value}")
        by_status[value].append(block)
    return [
        lane(str(s), count(run.count(s), "frame"), stretched(len(status), 1, by_status[s], f"{s}: {MEANING[s]}"))
        for s in found
    ]


def _submap_lane(run: RunData) -> Markup:
    n = len(run.rows)
    shapes, words = [], []
    owners = [(row.submap, bool(row.in_main_map)) for row in run.rows]
    for stretch in stretches(owners):
        submap, in_main = owners[stretch.start]
        if submap is None:
            continue
        where, cls = ("in the main map", "owner") if in_main else ("not linked to the main map", "owner apart")
        frames = span(run.rows[stretch.start].index, run.rows[stretch.stop - 1].index)
        shapes.append(_block(stretch.start, len(stretch), f"{frames}: submap {submap}, {where}", cls))
        if 100 * len(stretch) / n >= MIN_LABEL_PERCENT:
            centre = stretch.start + len(stretch) / 2
            words.append(_at(100 * centre / n, str(submap) if in_main else f"({submap})", "on-block"))
    note = "in brackets: not linked"
    return lane("submap", note if run.unlinked else "", stretched(n, 1, shapes, "Submap of each frame"), words)


def _event_lane(run: RunData) -> Markup:
    marks, row_of = [], run.row_of
    for event in run.events:
        row, kind = row_of.get(event.get("frame", -1)), event.get("event")
        if row is None or kind not in _MARKS:
            continue
        sign, cls, words = _MARKS[kind]
        marks.append(_at(_percent(run, row), sign, cls, f"frame {event['frame']}: {words}"))
    for i, _, row in run.losses:
        marks.append(_at(_percent(run, row), failure_letter(i), "break", f"failure {i}, lost since here"))
    return lane("events", "A failure, ○ new map, ◆ link, ↺ found again", tag("div", cls="empty-lane"), marks)


def _inlier_lane(run: RunData) -> Markup:
    matches = np.array([row.n_matches for row in run.rows], float)
    inliers = np.array([row.n_inliers for row in run.rows], float)
    top = max(float(matches.max()), 1.0)
    shapes = [_area(matches, top, "matches"), _area(inliers, top, "inliers")]
    threshold = (run.config.get("health") or {}).get("min_inliers")
    note = f"matched, and agreeing (dark), up to {number(top)}"
    if isinstance(threshold, int) and threshold < top:
        y = 100 * (1 - threshold / top)
        shapes.append(tag("path", cls="threshold", d=f"M0 {coordinate(y)}H{len(run.rows)}"))
        note += f"; dashed: {threshold} needed"
    drawing = stretched(len(run.rows), 100, shapes, "Landmarks matched and agreeing")
    return lane("landmarks", note, drawing, lane_values(number(top), "0"))


def _error_lane(run: RunData) -> Markup | None:
    """Draw the distance from the true position, where there is a truth."""
    error = position_errors(run)
    if not np.isfinite(error).any():
        return None
    top = float(np.nanmax(error))
    note = f"distance from the truth after alignment, each map by itself, up to {number(top)} m"
    shape = curve(error, max(top, 1e-12), "error")
    svg = stretched(len(run.rows), 100, shape, "Position error")
    return lane("error", note, svg, lane_values(f"{number(top)} m", "0"))


def _latency_lane(run: RunData) -> Markup:
    latency = np.array([row.latency_ms for row in run.rows])
    # Logarithmic, as a recovery in this process takes a thousand times longer than a frame.
    low, top = 1.0, max(float(latency.max()), 10.0)
    height = np.log10(np.clip(latency, low, None) / low)
    svg = stretched(len(latency), 100, _area(height, float(np.log10(top / low)), "latency"), "Latency of each frame")
    return lane("latency", "wall time of each frame, logarithmic", svg, lane_values(duration(top), duration(low)))


def _axis(run: RunData) -> Markup:
    words = frame_ticks([row.index for row in run.rows])
    n = len(run.rows)
    seconds = abs(run.rows[-1].timestamp_s - run.rows[0].timestamp_s)
    note = f"{n} frames, {number(seconds)} s"
    return lane("frame", note, tag("div", cls="empty-lane"), words, "axis")


def frame_ticks(indices: Sequence[int]) -> list[Markup]:
    """Return round frame numbers below a drawing that has one column for each of some frames."""
    n, first, last = len(indices), indices[0], indices[-1]
    words = []
    for value in ticks(min(first, last), max(first, last), 6):
        if abs(value - round(value)) > ROUNDING:  # of a few frames
            continue
        share = (value - first) / (last - first) if last != first else 0.0
        words.append(_at(100 * (share * (n - 1) + 0.5) / n, number(value, 6), "tick"))
    return words


# --- pieces


def lane(name: str, note: str, drawing: Markup, words: Sequence[Markup] = (), cls: str = "") -> Markup:
    """Return a named lane with its drawing, and words over it."""
    head = tag("div", tag("b", name), " ", tag("small", note), cls="lane-name")
    return tag("div", head, tag("div", drawing, words, cls="lane-body"), cls=f"lane {cls or name}")


def lane_values(top: str, bottom: str) -> list[Markup]:
    """Return the values at the upper and the lower end of a lane."""
    return [tag("span", text, cls=f"at value {place}") for text, place in ((top, "top"), (bottom, "bottom"))]


def _block(start: int, length: int, title: str, cls: str) -> Markup:
    return tag("rect", tag("title", title), cls=cls, x=start, y=0, width=length, height=1)


def _at(percent: float, text: str, cls: str, title: str | None = None) -> Markup:
    return tag("span", text, cls=f"at {cls}", style=f"left:{percent:.2f}%", title=title)


def _percent(run: RunData, row: int) -> float:
    return 100 * (row + 0.5) / len(run.rows)


def _columns(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return positions and values, the highest of each column where there are more than a screen shows."""
    n = len(values)
    edges = np.unique(np.linspace(0, n, min(n, MAX_COLUMNS) + 1).astype(int))
    highest = np.array([_highest(values[a:b]) for a, b in pairwise(edges)])
    return (edges[:-1] + edges[1:]) / 2, highest


def _highest(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.max()) if len(finite) else float("nan")


def _area(values: FloatArray, top: float, cls: str) -> Markup:
    x, y = _columns(values)
    points = "".join(f"L{coordinate(u)} {coordinate(100 * (1 - v / top))}" for u, v in zip(x, y, strict=True))
    return tag("path", cls=cls, d=f"M0 100{points}L{len(values)} 100Z")


def curve(values: FloatArray, top: float, cls: str) -> Markup:
    """Return a line that is broken where there is no value."""
    x, y = _columns(values)
    finite = np.isfinite(y).tolist()
    pieces = []
    for stretch in stretches(finite):
        if stretch.value:
            rows = range(stretch.start, stretch.stop)
            pieces.append("M" + "L".join(f"{coordinate(x[i])} {coordinate(100 * (1 - y[i] / top))}" for i in rows))
            if len(rows) == 1:
                pieces.append("h0")
    return tag("path", cls=cls, d="".join(pieces))
