"""What a frame costs: CPU in units of a feature extraction, and how a run keeps up with its camera.

    python benchmarks/cost.py [SEQUENCE ...] [--runs 1] [--out runs/cost] [--max-frames N] [--no-realtime]

The unit is one `cv2.ORB(2000)` extraction of the same frames, by one thread: machines differ and are shared,
milliseconds do not compare, this ratio nearly does. It is measured before and after each run, and both are printed:
where they differ much, something else was computing. Real time (`--realtime --workers 1`) says something only where
nothing else computes.

Without sequences: those under the folder that DUALSLAM_DATA names, or else a synthetic street and room. It measures and
prints; nothing depends on what it prints.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from dualslam.run.sources import open_source

STAGES = {
    "features": ("features",),
    "tracking": ("tracking",),
    "mapping": ("mapping",),
    "calibration": ("calibration", "calibration (beside)"),
    "walks": ("walk back", "merging"),
    "starts": ("initialisation", "shutter"),
    "at the end": ("final refinement", "ties"),
}
"""Columns of the table of stages, and what they hold; the graph, which is part of mapping, is taken out of it."""
GRAPH = "graph (in mapping)"
UNIT_FRAMES = 60


def main() -> None:
    """Run every sequence inline and in real time, each run in a process of its own, and print what it cost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="*")
    parser.add_argument(
        "--runs", type=int, default=1, help="with the seeds 1, 2, ...; medians are printed, worst behind"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/cost"))
    parser.add_argument("--max-frames", type=int)
    parser.add_argument("--no-realtime", action="store_true")
    args = parser.parse_args()
    options = [] if args.max_frames is None else ["--max-frames", str(args.max_frames)]
    sequences = args.sequences or _default_sequences()
    inline = {s: [_measured(s, args.out, seed, ["--inline", *options]) for seed in _seeds(args)] for s in sequences}
    _print_cost(inline)
    _print_stages(inline)
    if not args.no_realtime:
        live = ["--realtime", "--workers", "1", *options]
        real = {s: [_measured(s, args.out, seed, live) for seed in _seeds(args)] for s in sequences}
        _print_real_time(real, inline)


def _seeds(args: argparse.Namespace) -> range:
    return range(1, args.runs + 1)


def _default_sequences() -> list[str]:
    data = os.environ.get("DUALSLAM_DATA")
    if data:
        return [str(folder) for folder in sorted(Path(data).iterdir()) if (folder / "images").is_dir()]
    return ["synthetic:street,frames=150", "synthetic:room,frames=150"]


def _unit_ms(sequence: str) -> float:
    """CPU time of one extraction, milliseconds, on the sequence's first frames."""
    images = [f.image for f in islice(open_source(sequence), UNIT_FRAMES) if f.image is not None]
    grey = [image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
    cv2.setNumThreads(1)  # its threads would count as time, and not alike on every machine
    orb = cv2.ORB.create(2000)
    orb.detectAndCompute(grey[0], None)  # type: ignore[call-overload]
    start = time.process_time()
    for image in grey:
        orb.detectAndCompute(image, None)  # type: ignore[call-overload]
    return 1e3 * (time.process_time() - start) / len(grey)


def _measured(sequence: str, out: Path, seed: int, options: list[str]) -> dict[str, Any]:
    folder = out / f"{_name(sequence)}_{'live' if '--realtime' in options else 'inline'}_{seed}"
    command = [sys.executable, "-m", "dualslam.cli", "run", sequence, "--out", str(folder), "--overwrite", "--quiet"]
    before = _unit_ms(sequence)
    done = subprocess.run([*command, "--seed", str(seed), *options], check=False)
    if done.returncode not in (0, 1):
        sys.exit(done.returncode)
    summary: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    return summary | {"unit_ms": (before, _unit_ms(sequence))}


def _name(sequence: str) -> str:
    return Path(sequence).name.replace(":", "_").replace(",", "_")


def _unit(run: dict[str, Any]) -> float:
    return float(np.mean(run["unit_ms"]))


def _looked_at(run: dict[str, Any]) -> int:
    return max(int(run["frames"]) - int(run["dropped"]), 1)


def _print_cost(inline: dict[str, list[dict[str, Any]]]) -> None:
    print("\ninline, every frame in turn\n")
    _row("sequence", "units a frame", "unit ms", "coverage %", "ATE m", "peak RSS MB")
    _row(*["---"] * 6)
    for sequence, runs in inline.items():
        units = [run["unit_ms"] for run in runs]
        _row(
            _name(sequence),
            _both([run["cpu_ms_per_frame"] / _unit(run) for run in runs], 1),
            f"{min(map(min, units)):.1f} to {max(map(max, units)):.1f}",
            _both([100 * run["coverage"] for run in runs], 1, min),
            _both([run["ate_rmse_m"] for run in runs if run.get("ate_rmse_m") is not None], 3),
            _both([run["peak_rss_mb"] for run in runs], 0),
        )


def _print_stages(inline: dict[str, list[dict[str, Any]]]) -> None:
    print("\nwhere it goes, inline: units a frame; in the last column units a keyframe\n")
    _row("sequence", *STAGES, "graph", "graph, a keyframe")
    _row(*["---"] * (len(STAGES) + 3))
    for sequence, runs in inline.items():
        cells = []
        for parts in (*STAGES.values(), (GRAPH, "graph")):
            shares = [sum(run["stages_cpu_s"].get(part, 0.0) for part in parts) for run in runs]
            if parts == STAGES["mapping"]:
                shares = [s - run["stages_cpu_s"].get(GRAPH, 0.0) for s, run in zip(shares, runs, strict=True)]
            cells.append(
                _both([1e3 * s / _looked_at(run) / _unit(run) for s, run in zip(shares, runs, strict=True)], 1)
            )
        graph = [
            1e3 * run["stages_cpu_s"].get(GRAPH, 0.0) / max(run["stages_calls"].get(GRAPH, 0), 1) / _unit(run)
            for run in runs
        ]
        _row(_name(sequence), *cells, _both(graph, 1))


def _print_real_time(real: dict[str, list[dict[str, Any]]], inline: dict[str, list[dict[str, Any]]]) -> None:
    print("\nin real time, `--realtime --workers 1`: latency from when a frame is due to its pose\n")
    names = (
        "sequence",
        "dropped %",
        "latency ms p50 / p99 / max",
        "coverage, of inline's",
        "ATE, of inline's",
        "units",
    )
    _row(*names, "keyframes put off", "graph's lag, keyframes")
    _row(*["---"] * (len(names) + 2))
    for sequence, runs in real.items():
        pairs = list(zip(runs, inline[sequence], strict=True))
        latency = " / ".join(_both([run["latency_ms"][q] for run in runs], 0) for q in ("median", "p99", "max"))
        errors = [a["ate_rmse_m"] / b["ate_rmse_m"] for a, b in pairs if a.get("ate_rmse_m") and b.get("ate_rmse_m")]
        _row(
            _name(sequence),
            _both([100 * run["dropped"] / run["frames"] for run in runs], 1),
            latency,
            _both([a["coverage"] / max(b["coverage"], 1e-9) for a, b in pairs], 3, min),
            _both(errors, 2),
            _both([run["cpu_ms_per_frame"] / _unit(run) for run in runs], 1),
            _both([run["pace"]["put_off"] for run in runs], 0),
            _both([run["pace"]["max_lag_keyframes"] for run in runs], 0),
        )


def _both(values: list[float], digits: int, worst: Any = max) -> str:
    """Median, and the worst behind where there are several."""
    if not values:
        return "-"
    median = f"{statistics.median(values):.{digits}f}"
    return median if len(values) == 1 else f"{median} ({worst(values):.{digits}f})"


def _row(*cells: str) -> None:
    print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
