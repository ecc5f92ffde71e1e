"""A test of recovery for any system: clips about a loss, and how a system joins what is before and after it.

    python benchmarks/recovery_clips.py export --data DIR --out CLIPS
    python benchmarks/recovery_clips.py score CLIPS TRAJECTORIES

`export` writes one folder a clip: images/, times.txt, calib.txt, groundtruth_tum.txt, clip.json.

`score` reads TRAJECTORIES/NAME.txt, or TRAJECTORIES/NAME/trajectory.txt, for the clip CLIPS/NAME: TUM format, the
largest map. It prints whether the parts before and after the loss are joined right, joined wrong, or not joined. A clip
without a trajectory is not joined.
"""

from __future__ import annotations

import argparse
from collections import Counter
from functools import partial
from pathlib import Path

from dualslam.lab.audits.join_audit import JoinOutcome
from dualslam.lab.bench.clips import score_clip, write_clip
from dualslam.lab.bench.plan import plan_trials
from dualslam.lab.bench.spec import load_spec
from dualslam.run.bench_trial import describe_source
from dualslam.run.sources import open_source

SPEC = Path(__file__).with_name("recovery_clips.yaml")


def export(arguments: argparse.Namespace) -> None:
    """Write the clips."""
    spec = load_spec(SPEC).only(arguments.only).with_trials(arguments.trials, arguments.half)
    for trial in plan_trials(spec, partial(describe_source, data=arguments.data)):
        name = f"{trial.sequence}-{trial.condition}-{trial.number:02d}"
        frames = open_source(trial.source, start=trial.start, stride=trial.stride, max_frames=trial.max_frames or None)
        loss = write_clip(trial, frames, arguments.out / name)
        print(f"{name}: lost from {loss.first_s:.2f} s to {loss.after_s:.2f} s", flush=True)


def score(arguments: argparse.Namespace) -> None:
    """Judge the trajectories."""
    counts: dict[str, Counter[str]] = {}
    for clip in sorted(path.parent for path in arguments.clips.glob("*/clip.json")):
        files = (arguments.trajectories / f"{clip.name}.txt", arguments.trajectories / clip.name / "trajectory.txt")
        found = next((file for file in files if file.is_file()), None)
        outcome, detail = JoinOutcome.NOT_JOINED, ""
        if found is not None:
            join = score_clip(clip, found)
            outcome = join.outcome
            if join.offset_m is not None:
                detail = f", off by {join.offset_m:.3f} m, {join.turn_deg:.1f} deg, scale {join.scale_ratio:.3f}"
        print(f"{clip.name}: {outcome}{detail}")
        counts.setdefault(clip.name.split("-")[1], Counter())[outcome] += 1
    print("\n| disturbance | joined right | joined wrong | not joined |\n|---|---|---|---|")
    for name, count in counts.items():
        print(f"| {name} | {' | '.join(str(count[outcome]) for outcome in JoinOutcome)} |")


def main() -> None:
    """Export or score."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    write = commands.add_parser("export")
    write.add_argument("--data", type=Path, required=True)
    write.add_argument("--out", type=Path, required=True)
    write.add_argument("--only", action="append", default=[], metavar="SEQUENCE")
    write.add_argument("--trials", type=int)
    write.add_argument("--half", choices=("development", "reporting"))
    write.set_defaults(run=export)
    judge = commands.add_parser("score")
    judge.add_argument("clips", type=Path)
    judge.add_argument("trajectories", type=Path)
    judge.set_defaults(run=score)
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
