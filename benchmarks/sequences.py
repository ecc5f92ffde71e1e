"""Run the system on sequences with several seeds and print the table that goes into the README.

    python benchmarks/sequences.py [SEQUENCE ...] [--seeds 5] [--half development] [--out runs/bench]
                                   [--set KEY.PATH=VALUE] [--stride N]

Without sequences: those under the folder that DUALSLAM_DATA names, or else a synthetic street and room. It measures and
prints; nothing depends on what it prints. Settings are chosen on the development half of the seeds (from 0) and
reported on the other (from 100).
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

FIRST_SEED = {"development": 0, "reporting": 100}
COLUMNS = ("sequence", "coverage %", "ATE m", "failures", "submaps", "CPU ms/frame", "frames/s", "peak RSS MB")


def main() -> None:
    """Run every sequence with every seed, each in a process of its own, and print medians with the worst behind."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="*")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--half", choices=tuple(FIRST_SEED), default="reporting", help="which seeds")
    parser.add_argument("--out", type=Path, default=Path("runs/bench"))
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--stride", type=int, default=1)
    args = parser.parse_args()
    options = [option for setting in args.set for option in ("--set", setting)] + ["--stride", str(args.stride)]
    seeds = range(FIRST_SEED[args.half], FIRST_SEED[args.half] + args.seeds)
    print(f"{args.half} half, seeds {seeds[0]} to {seeds[-1]}, options:", " ".join(options))
    print("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS))
    for sequence in args.sequences or _default_sequences():
        name = Path(sequence).name.replace(":", "_").replace(",", "_")
        runs = [_run(sequence, args.out / f"{name}_{seed}", seed, options) for seed in seeds]
        print(_row(name, runs), flush=True)


def _default_sequences() -> list[str]:
    data = os.environ.get("DUALSLAM_DATA")
    if data:
        return [str(folder) for folder in sorted(Path(data).iterdir()) if (folder / "images").is_dir()]
    return ["synthetic:street,frames=300", "synthetic:room,frames=300"]


def _run(sequence: str, out: Path, seed: int, options: list[str]) -> dict[str, Any]:
    command = [sys.executable, "-m", "dualslam.cli", "run", sequence, "--out", str(out), "--overwrite", "--quiet"]
    done = subprocess.run([*command, "--inline", "--seed", str(seed), *options], check=False)
    if done.returncode not in (0, 1):
        sys.exit(done.returncode)
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return summary


def _row(name: str, runs: list[dict[str, Any]]) -> str:
    def median_and_worst(values: list[float | None], worst: Any, digits: int) -> str:
        known = [value for value in values if value is not None]
        if not known:
            return "-"
        return f"{statistics.median(known):.{digits}f} ({worst(known):.{digits}f})"

    cells = [
        name,
        median_and_worst([100 * run["coverage"] for run in runs], min, 1),
        median_and_worst([run.get("ate_rmse_m") for run in runs], max, 3),
        median_and_worst([run["failures"] for run in runs], max, 0),
        median_and_worst([run["submaps"] for run in runs], max, 0),
        median_and_worst([run["cpu_ms_per_frame"] for run in runs], max, 1),
        median_and_worst([run["fps"] for run in runs], min, 1),
        median_and_worst([run["peak_rss_mb"] for run in runs], max, 0),
    ]
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
