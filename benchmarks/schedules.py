"""Runs of a clip under stated schedules of the background work, in one process: coverage and error of each.

    python benchmarks/schedules.py data/kitti_03 --max-frames 200 --black 80 10 --seeds 1 2 3 --delays 0 1 5 20 never

Each schedule gives every kind of job one delay, or `--kinds` its own while the others keep their defaults. `--kill`
and `--hang` lose jobs of a kind, as dead and hung workers do. Each run prints one line of JSON; `--twice` makes it
again and says whether the trajectory is the same.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dualslam
from dualslam.core.jobs import JobKind
from dualslam.core.schedule import AT_ONCE, DELAYS, After
from dualslam.core.types import FailureReason
from dualslam.run.session import run_to_folder
from dualslam.testing.lossy import Lossy

ANSWERED = tuple(DELAYS)


def delay(text: str) -> float:
    """Return frames; `never` is the end of the run."""
    return math.inf if text == "never" else float(int(text))


def schedules(args: argparse.Namespace) -> Iterator[tuple[str, After]]:
    """Yield each schedule with its name."""
    for text in args.delays:
        kinds = [JobKind(kind) for kind in args.kinds] or list(ANSWERED)
        base = DELAYS if args.kinds else {}
        yield text, After({**base, **dict.fromkeys(kinds, delay(text))})
    if args.default:
        yield "default", After()
    if args.at_once:
        yield "inline", AT_ONCE


def made(args: argparse.Namespace, schedule: After, seed: int, out: Path) -> tuple[dict[str, Any], bytes]:
    """Make one run; return what it came to, and its trajectory."""
    overrides = [f"seed={seed}", f"recovery.workers={0 if schedule is AT_ONCE else 1}"]
    if args.black:
        start, length = args.black
        overrides.append(f"corruptions=[{{kind: blackout, start: {start}, length: {length}}}]")
    config = dualslam.load_config(overrides=overrides)
    sequence = dualslam.open_source(args.source, start=args.start, max_frames=args.max_frames)
    reason = FailureReason.TIMEOUT if args.hang else FailureReason.WORKER
    lossy = Lossy([JobKind(kind) for kind in args.hang or args.kill], args.every, seed, reason)

    def build(config: dualslam.Config, camera: Any) -> Any:
        system = dualslam.build_system(config, camera, schedule=schedule, in_process=True)
        if args.kill or args.hang:
            system.desk.executor = lossy.around(system.desk.executor)
        return system

    outcome = run_to_folder(config, sequence, out, overwrite=True, build=build)
    summary = outcome.summary
    told = {name: summary.get(name) for name in ("frames", "posed", "coverage", "ate_rmse_m", "links", "failures")}
    told["lost_jobs"] = lossy.n_lost
    return told, (out / "trajectory.txt").read_bytes()


def main() -> None:
    """Make all runs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source")
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--max-frames", type=int)
    parser.add_argument("--black", type=int, nargs=2, metavar=("START", "LENGTH"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--delays", nargs="*", default=[])
    parser.add_argument("--kinds", nargs="*", default=[], choices=[str(kind) for kind in ANSWERED])
    parser.add_argument("--default", action="store_true", help="the schedule that workers have without a clock, too")
    parser.add_argument("--at-once", action="store_true", help="inline, too")
    parser.add_argument("--kill", nargs="*", default=[], choices=[str(kind) for kind in ANSWERED])
    parser.add_argument("--hang", nargs="*", default=[], choices=[str(kind) for kind in ANSWERED])
    parser.add_argument("--every", type=int, default=3, help="of so many jobs of these kinds one is lost")
    parser.add_argument("--twice", action="store_true")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for name, schedule in schedules(args):
            for seed in args.seeds:
                told, trajectory = made(args, schedule, seed, Path(folder) / "run")
                if args.twice:
                    told["same_again"] = made(args, schedule, seed, Path(folder) / "run")[1] == trajectory
                print(json.dumps({"schedule": name, "kinds": args.kinds or "all", "seed": seed, **told}), flush=True)


if __name__ == "__main__":
    main()
