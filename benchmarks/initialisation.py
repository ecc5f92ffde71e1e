"""How late a map starts, and how often it starts wrong: from many frames of each sequence, ratio test against GMS.

    python benchmarks/initialisation.py [SEQUENCE ...] [--starts 50] [--frames 60] [--matching ratio gms]
                                        [--set KEY.PATH=VALUE] [--stride N]

From each of the start frames the initialiser is fed frames until it starts a map, as after a failure. A start is wrong
where the direction from its first to its last camera is more than 5 degrees off the ground truth's, and surely wrong
where it is so by more than two standard deviations of the truth: over a few centimetres that is not known to 5 degrees
itself. Of the errors over what the start says of its own (`direction_sigma_deg`) the median and the 90 % quantile are
given: for two axes and honest sigmas 1.2 and 2.1. Without sequences: those under the folder that DUALSLAM_DATA names,
or else a synthetic street and room. It measures and prints; nothing depends on what it prints.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from dualslam.backend.local_ba import bundle_adjust_arrays
from dualslam.core.config.files import load_config
from dualslam.core.config.settings import Config
from dualslam.core.types import FloatArray, Start, View
from dualslam.frontends.frame_reader import view_of
from dualslam.frontends.registry import create_frontend
from dualslam.frontends.tracking.initialiser import Initialiser
from dualslam.lab.audits.link_audit import truth_by_frame
from dualslam.lab.metrics.statistics import wilson_interval
from dualslam.run.sources import open_source

WRONG_DEG = 5.0
TRUTH_SIGMA_M = 0.003
"""Of a true position along each axis, against one a second away: what motion capture and depth fusion reach indoors."""
CERTAIN_SIGMAS = 2.0
COLUMNS = (
    "sequence",
    "matching",
    "started",
    "frames until then (median, 90 %)",
    "wrong",
    "wrong, 95 % interval",
    "surely wrong",
    "direction off (median), deg",
    "off over its sigma (median, 90 %)",
    "CPU ms a frame",
)


@dataclass(frozen=True)
class StartTrial:
    """The outcome of one start frame: frames until a map started, its error, the truth's own, and what the
    start says of its error; all None where none did.
    """

    delay: int | None
    error_deg: float | None
    truth_sigma_deg: float | None
    claimed_sigma_deg: float | None
    cpu_s: float
    n_fed: int


def main() -> None:
    """Find the features of each sequence once, and try both matchings on them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="*")
    parser.add_argument("--starts", type=int, default=50)
    parser.add_argument("--frames", type=int, default=60, help="fed at most from each start frame")
    parser.add_argument("--matching", nargs="+", default=["ratio", "gms"])
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--set", action="append", default=[], metavar="KEY.PATH=VALUE")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    print("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS))
    for source in args.sequences or default_sequences():
        config = load_config(overrides=args.set)
        views, truth, camera = read(source, config, args.stride)
        first = np.unique(np.linspace(0, max(len(views) - args.frames, 0), args.starts).astype(int)).tolist()
        for matching in args.matching:
            tried = load_config(overrides=[*args.set, f"initialiser.matching={matching}"])
            trials = [trial(views[i : i + args.frames], truth, camera, tried) for i in first]
            print(row(Path(source).name, matching, trials), flush=True)


def default_sequences() -> list[str]:
    """Return what `benchmarks/sequences.py` runs on."""
    data = os.environ.get("DUALSLAM_DATA")
    if data:
        return [str(folder) for folder in sorted(Path(data).iterdir()) if (folder / "images").is_dir()]
    return ["synthetic:street,frames=300", "synthetic:room,frames=300"]


def read(source: str, config: Config, stride: int) -> tuple[list[View], dict[int, FloatArray], Any]:
    """Views of all frames, their true poses, and the camera."""
    sequence: Any = open_source(source, stride=stride)
    frontend = create_frontend(config.frontend)
    found = [view_of(frame, frontend, sequence.camera, config.camera.model_sigma_px) for frame in sequence]
    views = [view for view in found if isinstance(view, View)]
    index, times = (np.array([getattr(view, name) for view in views]) for name in ("index", "timestamp_s"))
    return views, truth_by_frame(index, times, sequence.ground_truth), sequence.camera


def trial(views: list[View], truth: dict[int, FloatArray], camera: Any, config: Config) -> StartTrial:
    """Feed views until a map starts."""
    frontend = create_frontend(config.frontend)
    starter = Initialiser(frontend, bundle_adjust_arrays, config.initialiser, camera.K, camera.size_px, config.seed)
    begin = time.process_time()
    for n, view in enumerate(views):
        start = starter.add(view)
        if start:
            assert isinstance(start, Start)
            error_deg, truth_sigma_deg = direction_error_deg(start, truth) or (None, None)
            claimed = start.numbers["direction_sigma_deg"]
            return StartTrial(n, error_deg, truth_sigma_deg, claimed, time.process_time() - begin, n + 1)
    return StartTrial(None, None, None, None, time.process_time() - begin, len(views))


def direction_error_deg(start: Start, truth: dict[int, FloatArray]) -> tuple[float, float] | None:
    """Angle between the estimated and the true direction of motion, seen from the first camera, and the standard
    deviation of the true one; None without truth.
    """
    first, last = start.views[0].index, start.views[-1].index
    if first not in truth or last not in truth:
        return None
    true = truth[first][:3, :3].T @ (truth[last][:3, 3] - truth[first][:3, 3])
    found = start.T_first_cam[-1][:3, 3]
    cosine = true @ found / max(float(np.linalg.norm(true) * np.linalg.norm(found)), 1e-12)
    sigma = np.arctan2(np.sqrt(2) * TRUTH_SIGMA_M, np.linalg.norm(true))
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))), float(np.degrees(sigma))


def row(name: str, matching: str, trials: list[StartTrial]) -> str:
    """One line of the table."""
    delays = [each.delay for each in trials if each.delay is not None]
    errors = np.array([each.error_deg for each in trials if each.error_deg is not None])
    truth_sigmas = np.array([each.truth_sigma_deg for each in trials if each.error_deg is not None])
    claimed = np.array([each.claimed_sigma_deg for each in trials if each.error_deg is not None])
    n_wrong = int((errors > WRONG_DEG).sum())
    n_surely = int((errors - CERTAIN_SIGMAS * truth_sigmas > WRONG_DEG).sum())
    interval = wilson_interval(n_wrong, len(errors))
    late = f"{np.median(delays):.0f}, {np.quantile(delays, 0.9):.0f}" if delays else "-"
    cells = [
        name,
        matching,
        f"{len(delays)} of {len(trials)}",
        late,
        f"{n_wrong} of {len(errors)}",
        f"{100 * interval.low:.0f}-{100 * interval.high:.0f} %",
        f"{n_surely} of {len(errors)}",
        f"{np.median(errors):.1f}" if len(errors) else "-",
        f"{np.median(errors / claimed):.1f}, {np.quantile(errors / claimed, 0.9):.1f}" if len(errors) else "-",
        f"{1e3 * sum(each.cpu_s for each in trials) / sum(each.n_fed for each in trials):.0f}",
    ]
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
