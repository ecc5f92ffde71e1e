"""`dualslam explain`: prints the decisions about a frame of a run."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dualslam.core.errors import InputError
from dualslam.io.run_folder import DECISIONS, EVENTS, FRAMES, FrameRow
from dualslam.io.run_reading import read_decisions, read_events, read_frames, read_summary
from dualslam.report.markup import number
from dualslam.report.statuses import event_words

_SENTENCES = {
    "frame": ("The map explains the frame", "The map does not explain the frame"),
    "keyframe": ("The frame becomes a keyframe", "The frame does not become a keyframe"),
    "start": ("A map starts", "No map starts"),
    "walk": ("Reverse tracking ends here with a link", "Reverse tracking ends here without a link"),
    "link": ("The link is accepted", "The link is refused"),
    "place": ("The revisited place is joined", "The revisited place is not joined"),
}
_LONG = ("S_old_new", "agreeing_keyframes")
_SIGNS = {">": "more than", ">=": "at least", "<": "less than", "<=": "at most"}


def execute(args: argparse.Namespace) -> int:
    """Print the frame's outcome, and each decision about it."""
    print("\n".join(explain(args.run, args.frame)), flush=True)
    return 0


def explain(run: str | Path, frame: int) -> list[str]:
    """Return lines that say what happened to a frame, and why.

    - `run`: a run folder. All decisions are known of a run with ``--decisions``, else the frame's row and its events.
    - `frame`: index of the frame in the source.

    Raises `InputError` if the folder is none of a run, a file is damaged, or the run has no such frame.
    """
    run = Path(run)
    read_summary(run)
    rows = {row.index: row for row in read_frames(run / FRAMES)}
    if frame not in rows:
        has = f"; it has {min(rows)} to {max(rows)}" if rows else ""
        raise InputError(f"{run} has no frame {frame}{has}.")
    lines = [_row_words(rows[frame])]
    if (run / DECISIONS).is_file():
        for decision in read_decisions(run / DECISIONS):
            if decision["frame"] == frame:
                lines += _decision_lines(decision)
        return lines
    for event in read_events(run / EVENTS):
        if event.get("frame") == frame:
            lines.append(f"{event['event']}: {event_words(event)}")
    lines.append(f"{DECISIONS} is missing: run again with --decisions to see every decision with its thresholds.")
    return lines


def _row_words(row: FrameRow) -> str:
    words = f"Frame {row.index} ({row.timestamp_s:.3f} s): {row.status}"
    if row.submap is not None:
        words += f" in submap {row.submap}, {row.n_inliers} of {row.n_matches} matches agree"
    return words + ("." if not row.method else f", {row.method} search.")


def _decision_lines(decision: dict[str, Any]) -> Iterator[str]:
    accepted, refused = _SENTENCES.get(decision["what"], (f"{decision['what']}: yes", f"{decision['what']}: no"))
    words = accepted if decision["accepted"] else refused
    why = ": ".join(part for part in (decision["reason"].replace("_", " "), decision["detail"]) if part)
    yield words + (f" ({why})." if why else ".")
    for gate in decision["gates"]:
        outcome = "yes" if gate["passed"] else "no"
        sign = _SIGNS.get(gate["sign"], gate["sign"])
        yield f"  {gate['name']}: {_value(gate['value'])}, {sign} {_value(gate['threshold'])}: {outcome}"
    if known := event_words({name: value for name, value in decision["data"].items() if name not in _LONG}):
        yield f"  besides: {known}"


def _value(value: float | None) -> str:
    """Return a number in a few characters; null stands for infinity."""
    return "infinite" if value is None else number(value, 4)
