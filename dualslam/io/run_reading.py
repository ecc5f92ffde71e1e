"""Reader of a run folder: frames, events, numbers, and small pictures."""

from __future__ import annotations

import csv
import io
import json
import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dualslam.core.errors import InputError
from dualslam.core.types import FrameMethod, FrameStatus
from dualslam.io.run_folder import FRAME_COLUMNS, FRAMES, SAMPLE_NAME, SAMPLES, SUMMARY, files_named
from dualslam.io.trajectory_files import read_text
from dualslam.map.frame_numbers import FrameNumbers
from dualslam.map.frame_records import FrameRow

log = logging.getLogger(__name__)

OLD_FRAME_COLUMNS = (FRAME_COLUMNS[:8], FRAME_COLUMNS[:10])
"""Of runs made before claims were written, and before methods and doubts were."""
_Kinds = Mapping[str, tuple[tuple[type, ...], str]]
"""Of values by their names: the types that one may have, and what they are called."""
_SUMMARY_KINDS: _Kinds = {
    **dict.fromkeys(("frames", "posed", "failures", "recoveries", "submaps", "first_id"), ((int,), "a whole number")),
    "coverage": ((int, float), "a number"),
    **dict.fromkeys(("camera", "versions", "latency_ms", "stages_cpu_s"), ((dict,), "a mapping")),
    "first_index": ((int, type(None)), "a whole number"),
    "sequence": ((str,), "a word"),
}
"""Of what others build on in a summary: an earlier version may have written less."""
_EVENT_KINDS: _Kinds = {
    "event": ((str,), "a word"),
    "frame": ((int,), "a whole number"),
    "timestamp_s": ((int, float), "a number"),
    "submap": ((int, type(None)), "a whole number"),
    **dict.fromkeys(
        ("first_view", "keyframe", "lost_since", "old_submap", "other_frame", "other_submap", "suspected_since"),
        ((int, type(None)), "a whole number"),
    ),
    **dict.fromkeys(
        ("cost_after", "cost_before", "drift_log_scale", "frames", "inliers", "largest_bend", "largest_move", "matches")
        + ("n_agreeing_keyframes", "n_inliers", "n_matches", "n_pairs", "n_shared_keyframes", "scale", "seconds")
        + ("shared_keyframes", "sigma_rot_deg", "sigma_scale", "sigma_trans_mu", "skipped_frames", "tries"),
        ((int, float, type(None)), "a number"),
    ),
    **dict.fromkeys(
        ("agreeing_keyframes", "left", "lost", "old_submaps", "rejected", "submaps"), ((list, type(None)), "a list")
    ),
    "factors": ((dict,), "a mapping"),
}
"""Of what pages are made of; what else belongs to an event is shown as it is."""
_DECISION_KINDS: _Kinds = {
    "what": ((str,), "a word"),
    "frame": ((int,), "a whole number"),
    "accepted": ((bool,), "true or false"),
    "submap": ((int, type(None)), "a whole number"),
    "reason": ((str,), "a word"),
    "detail": ((str,), "a sentence"),
    "gates": ((list,), "a list"),
    "data": ((dict,), "a mapping"),
}


def read_frames(path: str | Path) -> list[FrameRow]:
    """Read a ``frames.csv``."""
    rows = []
    reader = csv.DictReader(io.StringIO(read_text(path)))
    if tuple(reader.fieldnames or ()) not in (FRAME_COLUMNS, *OLD_FRAME_COLUMNS):
        raise InputError(f"{path} is not a frames.csv: its columns should be {','.join(FRAME_COLUMNS)}.")
    for number, row in enumerate(reader, 2):
        try:
            rows.append(
                FrameRow(
                    index=int(row["index"]),
                    timestamp_s=_finite(row["timestamp_s"]),
                    status=FrameStatus(row["status"]),
                    submap=int(row["submap"]) if row["submap"] else None,
                    in_main_map=row["in_main_map"] == "1",
                    n_matches=int(row["n_matches"]),
                    n_inliers=int(row["n_inliers"]),
                    latency_ms=_finite(row["latency_ms"]),
                    sigma_position_rel=_sigma(row.get("sigma_position_rel")),
                    sigma_scale=_sigma(row.get("sigma_scale")),
                    method=FrameMethod(row["method"]) if row.get("method") else None,
                    doubt=row.get("doubt") or "",
                )
            )
        except (TypeError, ValueError) as e:
            raise InputError(f"{path}, line {number}: not a row of frames.csv ({e}).") from None
    return rows


def _finite(cell: str) -> float:
    value = float(cell)
    if not math.isfinite(value):
        raise ValueError(f"{cell} is no finite number")
    return value


def _sigma(cell: str | None) -> float | None:
    if not cell:
        return None
    value = float(cell)
    if not value >= 0:
        raise ValueError(f"{cell} is no standard deviation")
    return value


def read_summary(run: Path) -> dict[str, Any]:
    """Read ``summary.json`` of a run folder.

    Raises `InputError` if the folder is none of a run, or the file is damaged.
    """
    path = run / SUMMARY
    if not path.is_file():
        raise InputError(f"{run} is no run folder: there is no {SUMMARY}.")
    try:
        summary = json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise InputError(f"{path} is no valid JSON: {error}.") from None
    if not isinstance(summary, dict):
        raise InputError(f"{path} is no summary of a run.")
    if (misfit := _misfit(summary, _SUMMARY_KINDS)) is not None:
        raise InputError(f"{path} is damaged: {misfit}. Give another run, or run it again.")
    return summary


def read_numbers(run: Path) -> dict[int, int]:
    """Return the number that each frame of a run has in the run's map, by its index in the source.

    Raises `InputError` if the folder is none of a run, or a file is damaged.
    """
    summary = read_summary(run)
    numbers = FrameNumbers(summary.get("first_id", 0), summary.get("first_index"))
    return {row.index: numbers.number(row.index) for row in read_frames(run / FRAMES)}


def _misfit(values: Mapping[str, Any], kinds: _Kinds) -> str | None:
    """Return which value is of another type than a run writes, if one is."""
    for name, (types, what) in kinds.items():
        if name in values and not isinstance(values[name], types):
            return f"{name} is not {what}"
    return None


def read_events(path: str | Path) -> list[dict[str, Any]]:
    """Read an ``events.jsonl``; a last line that a crash cut off is left out."""
    return _read_lines(path, "event", _EVENT_KINDS)


def read_decisions(path: str | Path) -> list[dict[str, Any]]:
    """Read a ``decisions.jsonl``; a last line that a crash cut off is left out."""
    decisions = _read_lines(path, "decision", _DECISION_KINDS)
    for number, decision in enumerate(decisions, 1):
        if not decision.keys() >= _DECISION_KINDS.keys():
            raise InputError(f"{path}, line {number} is not a decision.")
        for gate in decision["gates"]:
            if not isinstance(gate, dict) or not gate.keys() >= {"name", "value", "sign", "threshold", "passed"}:
                raise InputError(f"{path}, line {number}: gates is not a list of comparisons.")
    return decisions


def _read_lines(path: str | Path, noun: str, kinds: _Kinds) -> list[dict[str, Any]]:
    """Read the objects of a file, one a line, each with the first field of `kinds`."""
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    values = []
    for number, line in enumerate(lines, 1):
        try:
            value = json.loads(line)
        except json.JSONDecodeError:
            if number < len(lines):
                raise InputError(f"{path}, line {number} is not valid JSON.") from None
            log.warning("%s: the last line is cut off and was left out", path)
            break
        if not isinstance(value, dict) or next(iter(kinds)) not in value:
            raise InputError(f"{path}, line {number} is not {'an' if noun == 'event' else 'a'} {noun}.")
        if (misfit := _misfit(value, kinds)) is not None:
            raise InputError(f"{path}, line {number}: {misfit}.")
        values.append(value)
    return values


def read_samples(run: str | Path) -> dict[int, bytes]:
    """Return the small pictures that a run kept, as JPEG, by frame index."""
    return {int(file.stem): file.read_bytes() for file in files_named(Path(run) / SAMPLES, SAMPLE_NAME)}
