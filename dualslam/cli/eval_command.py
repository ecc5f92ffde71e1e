"""`dualslam eval`: coverage first, then how far a run is from the truth."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from dualslam.core.errors import InputError
from dualslam.core.interfaces import Sequence
from dualslam.core.types import FloatArray
from dualslam.io.bags import has_topics
from dualslam.io.colours import load_pictures
from dualslam.io.map_files import to_plain
from dualslam.io.map_store import load_atlas
from dualslam.io.run_folder import FRAMES, MAP, SUMMARY, TRAJECTORY
from dualslam.io.run_reading import read_frames, read_numbers, read_summary
from dualslam.io.trajectory_files import read_tum
from dualslam.io.video import is_live
from dualslam.lab.metrics.trajectory_metrics import end_to_start, evaluate_run
from dualslam.run.sources import ANY_FOV_DEG, SYNTHETIC, open_images_of_run, open_source


def execute(args: argparse.Namespace) -> int:
    """Score a run folder and print it."""
    if not args.run.exists():
        raise InputError(f"{args.run} does not exist; give a run folder or a trajectory.")
    if is_live(args.sequence):
        raise InputError(f"{args.sequence} is live: it has no ground truth.")
    sequence = _open(args)
    times_s = _keyframe_times(args.run) if args.keyframes_only else None
    score: dict[str, Any] = {}
    if not args.returns or getattr(sequence, "ground_truth", None) is not None:
        score = evaluate_run(args.run, sequence, keyframe_times_s=times_s)  # type: ignore[arg-type]
    if args.returns:
        path = args.run / TRAJECTORY if args.run.is_dir() else args.run
        score |= end_to_start(read_tum(path, allow_empty=True))
    print(json.dumps(to_plain(score)) if args.json else score_text(score), flush=True)
    return 0


def score_text(score: dict[str, Any]) -> str:
    """Return a score as lines for a person."""
    lines = _one("main map", score) if "coverage_pct" in score else []
    if "end_to_start_pct" in score:
        lines.append(
            f"  the end is {score['end_to_start_pct']:.2f} % of the way from the start, "
            f"and turned by {score['end_to_start_deg']:.2f} deg"
        )
    if (keyframes := score.get("keyframes")) is not None:
        known = "ate_rmse_m" in keyframes
        error = f"ATE {keyframes['ate_rmse_m']:.4f} m RMSE" if known else "too few for an error"
        lines.append(f"  keyframes only: {error} ({keyframes['posed']} poses)")
    for submap in score.get("submaps", ()):
        lines += _one(f"submap {submap['submap']}, not linked", submap)
    return "\n".join(lines)


def _open(args: argparse.Namespace) -> Sequence:
    """Open the frames of the sequence that a run took. Refuse other images: many have the same times."""
    run, sequence = args.run, args.sequence
    summary = read_summary(run) if (run / SUMMARY).is_file() else {}
    camera, pictures = summary.get("camera") or {}, load_pictures(run / MAP)
    topic = summary.get("topic") if has_topics(Path(sequence)) else None
    # No camera is asked for a score: a sequence without a calibration has times and true poses all the same.
    fov_degrees = None if sequence.startswith(SYNTHETIC) else ANY_FOV_DEG
    chosen = summary.get("selection") or {}
    opened = open_source(sequence, fov_degrees=fov_degrees, time_unit=args.time_unit, topic=topic, **chosen)
    if pictures and summary.get("source") not in (sequence, str(Path(sequence).resolve())):
        open_images_of_run(sequence, (camera["width"], camera["height"]), topic, pictures)
    return opened


def _keyframe_times(run: Path) -> FloatArray:
    """Return the times of a run's keyframes in its main map."""
    stored = load_atlas(run)
    kept = {k for m in stored.main for k in stored.atlas.submaps[m].keyframes}
    numbers = read_numbers(run)
    return np.array([row.timestamp_s for row in read_frames(run / FRAMES) if numbers[row.index] in kept])


def _one(title: str, score: dict[str, Any]) -> list[str]:
    lines = [f"{title}: coverage {score['coverage_pct']:.1f} % ({score['posed']} of {score['frames']} frames)"]
    if score["off_clock"]:
        lines.append(f"  {score['off_clock']} poses belong to no frame of the sequence")
    if "ate_rmse_m" not in score:
        return [*lines, f"  {score['compared']} poses with ground truth: too few for an error"]
    lines.append(
        f"  ATE {score['ate_rmse_m']:.4f} m RMSE ({score['ate_pct_of_path']:.2f} % of {score['path_m']:.1f} m), "
        f"{score['ate_max_m']:.4f} m at most; a camera that stood still: {score['spread_m']:.3f} m"
    )
    if score.get("scale_drift") is not None:
        lines.append(f"  scale drift {score['scale_drift']:.4f} (last third over first)")
    if "rpe_1s_rot_deg_median" in score:
        translation = score.get("rpe_1s_trans_pct_median")
        rest = "" if translation is None else f", {translation:.2f} % of the distance"
        lines.append(f"  RPE over 1 s (median): {score['rpe_1s_rot_deg_median']:.3f} deg{rest}")
    if score.get("broken") is not None:
        where = f", the first at {score['first_broken_s']:.1f} s" if score["broken"] else ""
        lines.append(
            f"  silent breaks: {score['broken']} of {score['judged']} stretches of 2 s do not fit the truth{where}"
        )
    return lines
