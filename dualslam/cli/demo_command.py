"""`dualslam demo`: one drive through a synthetic street, twice: without recovery and with it, side by side."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dualslam.build import check_config
from dualslam.cli import logs
from dualslam.cli.compare_command import present
from dualslam.cli.configuration import check_free, config_of, naming_source
from dualslam.cli.console import progress
from dualslam.cli.run_command import conclude, naming_frontend
from dualslam.core.errors import InputError
from dualslam.core.types import Frame
from dualslam.io.run_folder import MAP_PAGE
from dualslam.report import read_run
from dualslam.run.session import run_to_folder
from dualslam.run.sources import WorldSequence, make_world

MIN_FRAMES = 60
BLACKOUT_FRAMES = 10
"""A second: enough to be lost, and little enough for the new map to know its scale as soon as it has started."""
WORLD_SEED = 0


def execute(args: argparse.Namespace) -> int:
    """Run twice on a street where the lens is covered half-way, and print both scores; the status is the last run's."""
    if args.frames < MIN_FRAMES:
        raise InputError(f"--frames {args.frames}: the demo needs at least {MIN_FRAMES} to lose track and start again.")
    config = config_of(args)
    with naming_source(args):
        check_config(config)
    page: Path = args.out / "compare.html"
    check_free(page, args.overwrite, "another folder with --out")
    if not args.quiet:
        first = args.frames // 2
        where = f"the lens is covered in frames {first} to {first + BLACKOUT_FRAMES - 1}"
        print(f"A street of {args.frames} frames, rendered first; {where}.", flush=True)
    logs.release()
    sequence = _Rendered(drive(args.frames))
    runs = []
    # Both in this process: the second's peak memory is at least the first's.
    for name, enabled in (("off", False), ("on", True)):
        if not args.quiet:
            print(f"Recovery {name}:", flush=True)
        with naming_frontend(config), progress(sequence, args.quiet) as shown:
            own = config.with_section("recovery", enabled=enabled)
            outcome = run_to_folder(own, sequence, args.out / name, overwrite=args.overwrite, watcher=shown)
        status = conclude(outcome, args)
        if outcome.report.interrupted:
            return status
        runs.append(read_run(outcome.out))
    present(runs, page, args.quiet)
    if not args.quiet:
        print(f"the joined map, to turn: {args.out / 'on' / MAP_PAGE}", flush=True)
    return status


def drive(n_frames: int) -> WorldSequence:
    """Return the drive through the street, the lens covered half-way."""
    covered: dict[str, Any] = {"kind": "blackout", "start": n_frames // 2, "length": BLACKOUT_FRAMES}
    return WorldSequence(make_world("street", n_frames, WORLD_SEED, [covered]))


class _Rendered:
    """A world whose frames are all rendered before it is driven through: so that both runs are timed alike."""

    def __init__(self, world: WorldSequence) -> None:
        self.name, self.camera, self.rate_hz = world.name, world.camera, world.rate_hz
        self.ground_truth, self.selection = world.ground_truth, world.selection
        self._frames = list(world)

    def __len__(self) -> int:
        return len(self._frames)

    def __iter__(self) -> Iterator[Frame]:
        return iter(self._frames)
