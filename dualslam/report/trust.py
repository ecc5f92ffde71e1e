"""Doubts about a run: lost scales, rejected answers, the map's own uncertainty; and what to do next."""

from __future__ import annotations

import shlex
from typing import Any

import numpy as np

from dualslam.core.noise_model import UNSURE_SCALE
from dualslam.core.types import FloatArray
from dualslam.report.markup import Markup, cards, coordinate, join, number, stretched, tag
from dualslam.report.run_data import RunData
from dualslam.report.timeline import frame_ticks

N_BINS = 120
_HEADS = ("frame", "submap", "what", "outcome")
_DOUBTS = {
    "look_alike": "two poses explain what is seen",
    "leap": "the camera cannot have moved so",
    "photometric": "the images disagree with the map",
    "ambiguous_model": "two places, or two poses, look alike",
    "contradiction": "the rest of the map contradicts it",
    "unconfirmed": "nothing has confirmed it",
}


def trust_section(run: RunData) -> Markup:
    """Return the words, the table of verdicts, and the strips of what is claimed."""
    rows = [
        (str(event["frame"]), "-" if event.get("submap") is None else str(event["submap"]), *told)
        for event in run.events
        if (told := _told(event)) is not None
    ]
    words = "A map is split where it loses its scale. Links, gaps and places with two explanations are not believed."
    verdicts = cards(_HEADS, rows) if rows else tag("p", "Nothing was doubted.", cls="empty")
    strips = (
        _strip(
            run,
            [row.sigma_scale for row in run.rows],
            "sigma of the size of two seconds of the path, against the best-tied ones",
            "Above it they may be 20 % too large or too small.",
            UNSURE_SCALE,
        ),
        _strip(
            run,
            [row.sigma_position_rel for row in run.rows],
            "sigma of the position, over the depth of the scene",
            "Against what the frame sees, not against where the run began.",
        ),
    )
    return join([tag("p", words), verdicts, *strips])


def _told(event: dict[str, Any]) -> tuple[str, str] | None:
    """Return the question and its outcome, where an event is about trust."""
    kind, detail = event.get("event"), str(event.get("detail") or "")
    if kind == "cut":
        return "its scale", f"lost: split off, {len(event['left'])} frames left without a pose in the main map"
    if kind == "failed" and event.get("reason") == "scale_lost":
        return "its scale", f"not handed on: parted ({detail})"
    if kind in ("failed", "link_refused", "loop_refused", "recovery_failed") and event.get("reason") in _DOUBTS:
        what = {"failed": "a pose", "loop_refused": "a place seen again"}.get(kind, "a link")
        tries = f", {int(event['tries'])} tries" if "tries" in event else ""
        return what, f"not believed: {_DOUBTS[event['reason']]}{tries}" + (f" ({detail})" if detail else "")
    if kind == "linked" and event.get("tries", 1) > 1:
        return "a link", f"believed at try {int(event['tries'])}"
    return None


def _strip(run: RunData, sigmas: list[float | None], name: str, note: str, threshold: float | None = None) -> Markup:
    """Return the largest claim of each stretch of frames as bars, on a logarithmic scale."""
    values = np.array([np.nan if sigma is None else sigma for sigma in sigmas])
    known = values[np.isfinite(values) & (values > 0)]
    if not len(known):
        return tag("p", f"No {name} is known.", cls="empty")
    low, high = np.floor(np.log10(known.min())), np.ceil(np.log10(known.max()) + 1e-9)
    high = max(high, low + 1, np.ceil(np.log10(threshold)) if threshold else high)
    bars = []
    parts = np.array_split(values, min(N_BINS, len(values)))
    first = 0
    for i, part in enumerate(parts):
        if (worst := _worst(part)) is not None:
            share = 1.0 if np.isinf(worst) else float((np.log10(max(worst, 10.0**low)) - low) / (high - low))
            frames = f"frames {run.rows[first].index} to {run.rows[first + len(part) - 1].index}"
            title = tag("title", f"{frames}: {'not known' if np.isinf(worst) else number(worst, 2)}")
            share = max(share, 0.01)
            bars.append(tag("rect", title, x=float(i), y=100 * (1 - share), width=0.9, height=100 * share, cls="bar"))
        first += len(part)
    if threshold is not None:
        y = 100 * (1 - (np.log10(threshold) - low) / (high - low))
        bars.append(tag("path", cls="threshold", d=f"M0 {coordinate(y)}H{len(parts)}"))
    svg = stretched(len(parts), 100, bars, f"{name}, frame by frame")
    median, p95 = (number(float(np.percentile(known, q)), 2) for q in (50, 95))
    dashed = "" if threshold is None else f" Dashed: {threshold:g}."
    caption = f"The {name} (no unit, logarithmic) over the frames: median {median}, 95 % below {p95}.{dashed} {note}"
    up = [
        tag("span", f"{10.0**d:g}", cls="at value", style=f"top:{100 * (high - d) / (high - low):.1f}%")
        for d in np.arange(low, high + 1)
    ]
    along = frame_ticks([row.index for row in run.rows])
    return tag("figure", tag("div", svg, up, along, cls="histogram axes"), tag("figcaption", caption))


def _worst(part: FloatArray) -> float | None:
    known = part[~np.isnan(part)]
    return float(known.max()) if len(known) else None


def camera_words(run: RunData) -> Markup | None:
    """Return the focal length, how sure it is, and where it is from; None where the run does not name its camera."""
    given: dict[str, Any] = run.summary.get("camera") or {}
    if "fx" not in given:
        return None
    search: dict[str, Any] = run.summary.get("focal_search") or {}
    source = f"from {run.summary.get('calibration') or 'the source, --camera or --fov'}"
    if search:
        low, high = (number(px, 4) for px in search.get("focal_range_px", (given["fx"],) * 2))
        source = f"searched for in the first frames ({low} to {high} px), as nothing was known of it"
    words = f"{given.get('model', 'camera')}, {given.get('width')} x {given.get('height')} pixels, "
    words += f"focal length {number(given['fx'], 4)} px, {source}."
    refined: dict[str, Any] = run.summary.get("refined") or {}
    if refined:
        sigma = 100 * float(refined["log_focal_sigma"])
        words += f" Self-calibration made it {number(refined['focal_px'], 4)} px, sigma {number(sigma, 2)} %."
    else:
        words += " It was kept as it is."
    return tag("p", tag("b", "Camera: "), words)


def next_steps(run: RunData) -> Markup:
    """Return the section: each step with the command that takes it."""
    here = shlex.quote(str(run.path))
    source = shlex.quote(str(run.summary.get("source") or "SOURCE"))
    if not len(run.main):
        return _steps([("Try it with a calibration:", f"dualslam run {source} --camera FILE --out NEW")])
    posed = [run.rows[r].index for r in run.main.row[[0, -1]].tolist()]
    steps = [
        ("A radiance field or Gaussian splats:", f"dualslam export {here} --to nerfstudio --every 3 --out SPLAT"),
        ("Points with colours:", f"dualslam export {here} --to ply --out map.ply"),
        (
            "Metres, by a distance that you know between two frames:",
            f"dualslam scale {here} --distance {posed[0]} {posed[1]} METRES",
        ),
        ("Continue this map with another recording:", f"dualslam run SOURCE --map {here} --out NEW"),
        ("Find poses in this map and add nothing:", f"dualslam run SOURCE --map {here} --localise --out NEW"),
    ]
    if run.summary.get("focal_search"):
        better = f"dualslam run {source} --camera FILE --out NEW"
        steps.insert(0, ("The camera was searched for; a calibration does better:", better))
    if len(run.truth):
        steps.insert(0, ("Errors against the ground truth:", f"dualslam eval {here} {source}"))
    return _steps(steps)


def _steps(steps: list[tuple[str, str]]) -> Markup:
    return join([tag("p", words, tag("pre", command, cls="command")) for words, command in steps])
