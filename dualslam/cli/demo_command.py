"""`dualslam demo`: drive through a synthetic street, lose track on the way, and show what is left of the map."""

from __future__ import annotations

import argparse
from typing import Any

from dualslam.cli import logs
from dualslam.cli.configuration import config_of
from dualslam.cli.console import progress
from dualslam.cli.eval_command import score_text
from dualslam.cli.run_command import conclude
from dualslam.core.errors import InputError
from dualslam.evaluation.trajectory_metrics import evaluate_run
from dualslam.session import run_to_folder
from dualslam.sources import WorldSequence, make_world

MIN_FRAMES = 60
BLACKOUT_FRAMES = 15
WORLD_SEED = 0


def execute(args: argparse.Namespace) -> int:
    """Run on a street where the lens is covered half-way, and print the evaluation."""
    if args.frames < MIN_FRAMES:
        raise InputError(f"--frames {args.frames}: the demo needs at least {MIN_FRAMES} to lose track and start again.")
    config = config_of(args)
    covered: dict[str, Any] = {"kind": "blackout", "start": args.frames // 2, "length": BLACKOUT_FRAMES}
    sequence = WorldSequence(make_world("street", args.frames, WORLD_SEED, [covered]))
    if not args.quiet:
        last = covered["start"] + BLACKOUT_FRAMES - 1
        print(f"A street of {args.frames} frames; the lens is covered in frames {covered['start']} to {last}.")
    logs.release()
    with progress(sequence, args.quiet) as on_frame:
        outcome = run_to_folder(config, sequence, args.out, overwrite=args.overwrite, on_frame=on_frame)
    if not args.quiet:
        print(score_text(evaluate_run(args.out, sequence)))
    return conclude(outcome, args)
