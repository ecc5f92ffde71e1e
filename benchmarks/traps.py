"""Silent breaks and wrong joins on the embedded worlds in which maps go wrong unseen.

    python benchmarks/traps.py --seeds 101 102 103
    python benchmarks/traps.py --worlds parked board --gaps 0.5 2 4 --occlude 0.7 1 --seeds 101 102 103 104

Prints one line a run: world, seed, trap, share of frames in the main map, stretches broken of those judged, submaps,
RMS error in metres, the join across the trap, events, CPU seconds. Then it prints one row a cell.
`dualslam/lab/audits/silent_breaks.py` and `join_audit.py` there say what is broken and what is joined wrongly.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import dataclass

import numpy as np

import dualslam
from dualslam.core.config.corruption import Corruption, CorruptionKind
from dualslam.core.events import EventKind
from dualslam.lab.audits.join_audit import JoinAudit, JoinOutcome, audit_join
from dualslam.lab.audits.silent_breaks import find_silent_breaks
from dualslam.lab.disturbances import corrupted
from dualslam.lab.metrics.alignment import distances_when_aligned
from dualslam.lab.synthetic import make_sequence
from dualslam.lab.synthetic.traps import BOARD_PERIOD_M, CAR_PERIOD_M

FRAMES = {"parked": 130, "board": 130, "takeoff": 130, "standstill": 70, "hover": 170}
AFTER_TRAP = 90
"""Frames that follow a trap, at least: three seconds to start a map and join it."""
TRAP_AT = 75
"""First disturbed frame of `parked` and `board`."""
PERIODS_M = {"parked": CAR_PERIOD_M, "board": BOARD_PERIOD_M}
"""Of the worlds that repeat. A part that is off by more than half of it is joined wrongly."""
RATE_HZ = 30.0
SHOWN = (
    EventKind.FAILED,
    EventKind.LINKED,
    EventKind.MERGED,
    EventKind.GAP_RELOCALISED,
    EventKind.CUT,
)


@dataclass(frozen=True, slots=True)
class Trap:
    """A disturbance: its name in the tables, and its corruption, if there is one."""

    name: str
    corruption: Corruption | None = None

    @property
    def end(self) -> int:
        """First frame after it."""
        return TRAP_AT if self.corruption is None else TRAP_AT + (self.corruption.length or 0)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a run gave: its line, and the columns of the cell's row that it counts in."""

    line: str
    columns: tuple[str, ...]


def make_trap(kind: CorruptionKind, seconds: float, strength: float | None, seed: int) -> Trap:
    """Return the trap of a kind that lasts so many seconds."""
    length = max(1, round(seconds * RATE_HZ))
    name = f"gap {seconds:.2g} s" if strength is None else f"occluded {strength:g}, {seconds:.2g} s"
    return Trap(name, Corruption(kind=kind, start=TRAP_AT, length=length, strength=strength, seed=seed))


def run(world: str, seed: int, trap: Trap, n_frames: int) -> Outcome:
    """Run a world once."""
    began = time.process_time()
    sequence = make_sequence(world, n_frames=n_frames, seed=seed, width=480, height=360, supersampling=1.0)
    system = dualslam.build_system(dualslam.load_config(overrides=[f"seed={seed}"]), sequence.camera)
    disturbed = corrupted(sequence, () if trap.corruption is None else (trap.corruption,))
    n_arrived = len([system.step(frame) for frame in disturbed])
    system.finish()
    head = f"{world:11s} {seed:5d} {trap.name:18s}"
    if not system.atlas.submaps:
        return Outcome(f"{head}  no map", ("no map",))
    found = ", ".join(f"{kind} {n}" for kind in SHOWN if (n := len(system.events.of_kind(kind))))
    main = dualslam.trajectories_of(system).main
    T_true = sequence.ground_truth_T_world_cam[main.index]
    p, q = main.T_world_cam[:, :3, 3], T_true[:, :3, 3]
    rmse = float(np.sqrt((distances_when_aligned(p, q) ** 2).mean()))
    breaks = find_silent_breaks(sequence.timestamps_s[main.index], p, q, 1.0 / sequence.rate_hz)
    judged = "-" if breaks is None else f"{breaks.broken or 0}/{breaks.judged}"
    columns = ("broken",) if breaks is not None and breaks.broken else ()
    joined = ""
    if trap.corruption is not None:
        join = audit_join(main.index, main.T_world_cam, T_true, TRAP_AT, trap.end, PERIODS_M[world] / 2.0)
        joined = _join_text(join)
        columns += (join.outcome.value,)
    return Outcome(
        f"{head}  {len(main) / n_arrived:6.1%}  broken {judged:5s}  submaps {len(system.atlas.submaps)}"
        f"  {rmse:.4f} m  {joined}{found}  {time.process_time() - began:.0f} s",
        columns,
    )


def _join_text(join: JoinAudit) -> str:
    if join.offset_m is None:
        return f"{join.outcome} ({join.n_before} frames before, {join.n_after} after), "
    return f"{join.outcome} (off by {join.offset_m:.3f} m, scale {join.scale_ratio:.3f}), "


def traps_of(arguments: argparse.Namespace, world: str, seed: int) -> list[Trap]:
    """Return the traps of a world: those that are asked for, or one gap of a third of a second to one, by the seed."""
    if world not in PERIODS_M:
        return [Trap("-")]
    traps = [make_trap(CorruptionKind.DROP, seconds, None, seed) for seconds in arguments.gaps or ()]
    if arguments.occlude:
        share, seconds = arguments.occlude
        traps.append(make_trap(CorruptionKind.OCCLUSION, seconds, share, seed))
    return traps or [make_trap(CorruptionKind.DROP, (10 + 7 * (seed % 4)) / RATE_HZ, None, seed)]


def main() -> None:
    """Run all worlds for all seeds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[101, 102, 103])
    parser.add_argument("--worlds", nargs="+", choices=sorted(FRAMES), default=list(FRAMES))
    parser.add_argument("--frames", type=int, help="length of parked and board (default: 90 frames after the trap)")
    parser.add_argument("--gaps", type=float, nargs="+", metavar="SECONDS", help="missing in parked and board")
    parser.add_argument("--occlude", type=float, nargs=2, metavar=("SHARE", "SECONDS"), help="of parked and board")
    arguments = parser.parse_args()
    dualslam.limit_threads()
    cells: dict[tuple[str, str], Counter[str]] = {}
    for seed in arguments.seeds:
        for world in arguments.worlds:
            for trap in traps_of(arguments, world, seed):
                least = trap.end + AFTER_TRAP if arguments.gaps or arguments.occlude else 0
                n_frames = arguments.frames if arguments.frames and world in PERIODS_M else max(FRAMES[world], least)
                outcome = run(world, seed, trap, n_frames)
                print(outcome.line, flush=True)
                cells.setdefault((world, trap.name), Counter()).update(("runs", *outcome.columns))
    _print_cells(cells)


def _print_cells(cells: dict[tuple[str, str], Counter[str]]) -> None:
    shown = ("runs", *(outcome.value for outcome in JoinOutcome), "broken", "no map")
    print(f"\n| world | trap | {' | '.join(shown)} |\n|{'---|' * (len(shown) + 2)}")
    for (world, trap), counts in cells.items():
        print(f"| {world} | {trap} | {' | '.join(str(counts[name]) for name in shown)} |")


if __name__ == "__main__":
    main()
