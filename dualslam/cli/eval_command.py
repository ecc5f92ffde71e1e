"""`dualslam eval`: coverage first, then how far a run is from the truth."""

from __future__ import annotations

import argparse
import json
from typing import Any

from dualslam.core.errors import InputError
from dualslam.io.map_files import to_plain
from dualslam.io.video import is_live
from dualslam.lab.metrics.trajectory_metrics import evaluate_run
from dualslam.run.sources import ANY_FOV_DEG, SYNTHETIC, open_source


def execute(args: argparse.Namespace) -> int:
    """Score a run folder and print it."""
    if not args.run.exists():
        raise InputError(f"{args.run} does not exist; give a run folder or a trajectory.")
    if is_live(args.sequence):
        raise InputError(f"{args.sequence} is live: it has no ground truth.")
    # No camera is asked for a score: a sequence without a calibration has times and true poses all the same.
    fov_degrees = None if args.sequence.startswith(SYNTHETIC) else ANY_FOV_DEG
    sequence = open_source(args.sequence, fov_degrees=fov_degrees, time_unit=args.time_unit)
    score = evaluate_run(args.run, sequence)  # type: ignore[arg-type]
    print(json.dumps(to_plain(score)) if args.json else score_text(score), flush=True)
    return 0


def score_text(score: dict[str, Any]) -> str:
    """Return a score as lines for a person."""
    lines = _one("main map", score)
    for submap in score["submaps"]:
        lines += _one(f"submap {submap['submap']}, not linked", submap)
    return "\n".join(lines)


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
