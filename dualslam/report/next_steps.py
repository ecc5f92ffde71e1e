"""The camera of a run, and what a person may do next: commands to copy."""

from __future__ import annotations

import shlex
from typing import Any

from dualslam.report.markup import Markup, join, number, tag
from dualslam.report.run_data import RunData


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
