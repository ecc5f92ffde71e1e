"""The trajectory from above: what was tracked, recovered and by-passed, and where it broke."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dualslam.core.types import FloatArray, FrameStatus, IntArray
from dualslam.report.canvas import Canvas
from dualslam.report.markup import Markup, join, tag
from dualslam.report.placement import Placed, PlacedRun, extent, place, plane_from_above
from dualslam.report.run_data import RunData
from dualslam.report.statuses import MEANING, Stretch, count, span, stretches

MIN_CLOSE_UP = 4
BEYOND = 40
"""Rows before and after those of a close-up that are drawn where they are in sight."""
_TOGETHER_PERCENT = 15.0
"""Of the drawing: on a telephone, the words at two points that are nearer lie upon each other."""
LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"


def top_view(run: RunData) -> Markup:
    """Return the section with the trajectory, or with the reason why there is none."""
    scene = place(run)
    if not scene.placed and not scene.apart:
        return tag("p", "No frame has a pose, so there is no trajectory to draw.", cls="empty")
    parts = (
        [tag("figure", _drawing(run, scene, _axes(scene)), tag("figcaption", _legend(run, scene)))]
        if scene.placed
        else []
    )
    for placed in scene.apart:
        alone = PlacedRun([placed], scene.down * 0)
        words = f"Submap {placed.submap}, not linked, in its own frame and unit: {count(len(placed.row), 'frame')}."
        parts.append(tag("figure", _drawing(run, alone, _axes(alone)), tag("figcaption", tag("p", words)), cls="apart"))
    return join(parts)


def close_up(run: RunData, scene: PlacedRun, rows: tuple[int, int], marked: Sequence[int]) -> Markup | None:
    """Return the part of the drawing that some frames are in, or None where none of them has a place.

    - `rows` (first, last).
    - `marked`: rows that get a mark: the keyframes on which a link rests.
    """
    window = [xyz[(row >= rows[0]) & (row <= rows[1])] for row, xyz in _lines(scene)]
    if sum(len(xyz) for xyz in window) < MIN_CLOSE_UP:
        return None
    # What lies far from there in time may cross the window all the same; it would only confuse.
    low, high = rows[0] - BEYOND, rows[1] + BEYOND
    placed = [_cut(p, low, high) for p in scene.placed]
    kept = (scene.truth_row >= low) & (scene.truth_row <= high)
    near = replace(
        scene,
        placed=[p for p in placed if len(p.row)],
        truth_row=scene.truth_row[kept],
        truth_xyz=scene.truth_xyz[kept],
    )
    return _drawing(run, near, _axes(scene), window, marked) if near.placed else None


def _axes(scene: PlacedRun) -> FloatArray:
    return plane_from_above(np.concatenate([xyz for _, xyz in _lines(scene)]), scene.down)[0]


def _lines(scene: PlacedRun) -> list[tuple[IntArray, FloatArray]]:
    return [*((p.row, p.xyz) for p in scene.placed), (scene.truth_row, scene.truth_xyz)]


def _cut(placed: Placed, low: int, high: int) -> Placed:
    kept = (placed.row >= low) & (placed.row <= high)
    return Placed(placed.submap, placed.row[kept], placed.xyz[kept], placed.error[kept])


def _drawing(
    run: RunData,
    scene: PlacedRun,
    axes: FloatArray,
    window: Sequence[FloatArray] | None = None,
    marked: Sequence[int] = (),
) -> Markup:
    drawn = [xyz for _, xyz in _lines(scene)]
    canvas = Canvas.around(*extent([xyz @ axes.T for xyz in window or drawn]))
    shapes = [canvas.dots(scene.points @ axes.T, "landmarks") if len(scene.points) else None]
    shapes += _truth(run, scene, canvas, axes)
    words: list[Markup] = []
    for placed in scene.placed:
        shapes += [] if len(scene.truth_row) else _bridges(run, placed, canvas, axes)
        shapes += _path(run, placed, canvas, axes)
        if placed.submap is not None and len(placed.row) and window is None:
            words.append(canvas.label(placed.xyz[len(placed.row) // 2] @ axes.T, f"submap {placed.submap}", "name"))
        at = placed.xyz[np.isin(placed.row, marked)]
        words += [canvas.label(uv, "◆", "agreeing", "keyframe that supports the link") for uv in at @ axes.T]
    words += _ends(scene, canvas, axes) if window is None else []
    words += _breakages(run, scene, canvas, axes)
    words.append(canvas.scale_bar(scene.unit, np.concatenate(drawn) @ axes.T))
    return canvas.draw(shapes, words, _description(run, scene))


def _description(run: RunData, scene: PlacedRun) -> str:
    n_failures = len(run.events_of("failed"))
    n_posed = sum(len(p.row) for p in scene.placed)
    truth = ", with the true path" if len(scene.truth_row) else ""
    return f"Trajectory from above: {n_posed} posed frames{truth}; tracking failed {count(n_failures, 'time')}"


def _path(run: RunData, placed: Placed, canvas: Canvas, axes: FloatArray) -> list[Markup]:
    """Draw a trajectory, each stretch of one status by itself, joined to the frame before it."""
    uv = placed.xyz @ axes.T
    status = [run.rows[i].status for i in placed.row.tolist()]
    # A line does not bridge frames without a pose.
    pieces = np.cumsum(np.diff(placed.row, prepend=placed.row[0]) > 1).tolist()
    loose = " loose" if placed.submap is not None else ""
    where = "main map" if placed.submap is None else f"submap {placed.submap}, not linked"

    def draw(stretch: Stretch, first: int, cls: str, words: str) -> Markup:
        frames = span(run.rows[int(placed.row[stretch.start])].index, run.rows[int(placed.row[stretch.stop - 1])].index)
        return canvas.line(uv[first : stretch.stop], cls, f"{frames}: {words}, {where}")

    shapes = []
    for stretch in stretches(list(zip(status, pieces, strict=True))):
        first = stretch.start - (stretch.start > 0 and pieces[stretch.start - 1] == pieces[stretch.start])
        value = status[stretch.start]
        shapes.append(draw(stretch, first, f"way st-{value}{loose}", str(value)))
    doubt = _doubts(run, placed)
    shapes += [
        draw(stretch, stretch.start, "doubtful", f"doubtful ({doubt[stretch.start]})")
        for stretch in stretches(list(zip(doubt, pieces, strict=True)))
        if doubt[stretch.start]
    ]
    return shapes


def _doubts(run: RunData, placed: Placed) -> list[str]:
    """Return the doubt of each frame of the main map; a map that is not linked is drawn loose instead."""
    return [run.rows[i].doubt if placed.submap is None else "" for i in placed.row.tolist()]


def _bridges(run: RunData, placed: Placed, canvas: Canvas, axes: FloatArray) -> list[Markup]:
    """Draw straight lines over the frames that have no pose in this map, where no true path shows them."""
    uv = placed.xyz @ axes.T
    rows = placed.row.tolist()
    return [
        canvas.line(
            uv[i : i + 2],
            "gap",
            f"{span(run.rows[rows[i] + 1].index, run.rows[rows[i + 1] - 1].index)}: no pose in this map",
        )
        for i in np.flatnonzero(np.diff(placed.row) > 1).tolist()
    ]


def _truth(run: RunData, scene: PlacedRun, canvas: Canvas, axes: FloatArray) -> list[Markup]:
    """Draw the true path, and on it where the run has no pose at all."""
    if not len(scene.truth_row):
        return []
    uv = scene.truth_xyz @ axes.T
    shapes = [canvas.line(uv, "truth", "true path")]
    posed = np.zeros(len(run.rows), bool)
    for placed in (*scene.placed, *scene.apart):
        posed[placed.row] = True
    for stretch in stretches(posed[scene.truth_row].tolist()):
        if stretch.value:
            continue
        around = uv[max(stretch.start - 1, 0) : stretch.stop + 1]
        rows = scene.truth_row[[stretch.start, stretch.stop - 1]].tolist()
        frames = span(run.rows[rows[0]].index, run.rows[rows[1]].index)
        shapes.append(canvas.line(around, "gap", f"{frames}: no pose"))
    return shapes


def _ends(scene: PlacedRun, canvas: Canvas, axes: FloatArray) -> list[Markup]:
    # The truth has both ends; without it the main map's first and last pose stand for them.
    xyz = scene.truth_xyz if len(scene.truth_row) else scene.placed[0].xyz
    uv = xyz[[0, -1]] @ axes.T
    start, end = (np.array(canvas.to_percent(at)) for at in uv)
    if (np.abs(start - end) < _TOGETHER_PERCENT).all():
        return [canvas.label(uv[0], "start, end", "end-mark start", "first and last frame")]
    return [
        canvas.label(uv[0], "start", "end-mark start", "first frame"),
        canvas.label(uv[1], "end", "end-mark stop", "last frame"),
    ]


def _breakages(run: RunData, scene: PlacedRun, canvas: Canvas, axes: FloatArray) -> list[Markup]:
    """Mark where each failure began: at the last frame that had a pose before it."""
    rows = np.concatenate([p.row for p in scene.placed])
    xyz = np.concatenate([p.xyz for p in scene.placed])
    if len(scene.truth_row):  # there the loss itself has a place
        rows, xyz = scene.truth_row, scene.truth_xyz
    marks = []
    for i, frame, onset in run.losses:
        before = np.flatnonzero(rows <= onset)
        if not len(before):
            continue
        at = before[np.argmax(rows[before])]
        title = f"failure {i}: track lost at frame {frame}"
        marks.append(canvas.label(xyz[at] @ axes.T, failure_letter(i), "break", title))
    return marks


def failure_letter(i: int) -> str:
    """Return the mark of the i-th failure, from 1."""
    return LETTERS[i - 1] if i <= len(LETTERS) else str(i)


def _legend(run: RunData, scene: PlacedRun) -> list[Markup]:
    drawn = {run.rows[i].status for placed in scene.placed for i in placed.row.tolist()}
    items = [_key(f"way st-{s}", f"{s}: {MEANING[s]}") for s in FrameStatus if s in drawn]
    if len(scene.truth_row):
        items += [_key("truth", "true path"), _key("gap", "no pose (drawn on the true path)")]
    elif any((np.diff(placed.row) > 1).any() for placed in scene.placed):
        items.append(_key("gap", "no pose (a straight line)"))
    if any(any(_doubts(run, placed)) for placed in scene.placed):
        items.append(_key("doubtful", "doubtful: a reason of the verdict concerns these frames"))
    if any(p.submap is not None for p in scene.placed):
        items.append(_key("way st-tracked loose", "a submap that is not linked, aligned by itself"))
    if len(scene.points):
        items.append(_key("landmarks", "landmarks of the main map"))
    if run.events_of("failed"):
        items.append(tag("li", tag("span", "A", cls="break sample"), " where tracking failed"))
    _, view = plane_from_above(np.concatenate([p.xyz for p in scene.placed]), scene.down)
    return [tag("ul", items, cls="legend"), tag("p", f"{view[0].upper()}{view[1:]}. {scene.note}")]


def _key(cls: str, words: str) -> Markup:
    d = "M4 6h0m10 4h0m9 -5h0" if cls == "landmarks" else "M2 7h26"
    svg = tag("svg", tag("path", cls=cls, d=d), viewBox="0 0 30 14", aria_hidden="true")
    return tag("li", svg, " ", words)
