"""Silent breaks on the embedded worlds in which maps go wrong unseen: `python benchmarks/traps.py --seeds 101 102 103`.

Prints for each run its world, seed and gap, the share of frames in the main map, stretches broken and judged
(`dualslam/lab/audits/silent_breaks.py`), submaps, RMS error in metres after one alignment, and what was found.
"""

from __future__ import annotations

import argparse

import numpy as np

import dualslam
from dualslam.core.events import EventKind
from dualslam.lab.audits.silent_breaks import find_silent_breaks
from dualslam.lab.metrics.alignment import distances_when_aligned
from dualslam.lab.synthetic import make_sequence

FRAMES = {"parked": 130, "board": 130, "takeoff": 130, "standstill": 70, "hover": 170}
GAP_AT = 75
"""Of `parked` and `board`: the first frame that is missing; a third of a second to one, by the seed."""
TOLD = (EventKind.FAILED, EventKind.LINKED, EventKind.GAP_RELOCALISED, EventKind.AUDITED, EventKind.CUT)


def run(world: str, seed: int) -> str:
    """Run a world once, and return its outcome in one line."""
    gap = 10 + 7 * (seed % 4) if world in ("parked", "board") else 0
    sequence = make_sequence(world, n_frames=FRAMES[world], seed=seed, width=480, height=360, supersampling=1.0)
    system = dualslam.build_system(dualslam.load_config(overrides=[f"seed={seed}"]), sequence.camera)
    frames = [frame for frame in sequence if not GAP_AT <= frame.index < GAP_AT + gap]
    for frame in frames:
        system.step(frame)
    system.finish()
    found = ", ".join(f"{kind} {n}" for kind in TOLD if (n := len(system.events.of_kind(kind))))
    if not system.atlas.submaps:
        return f"{world:11s} {seed:5d} gap {gap:2d}  no map"
    main = dualslam.trajectories_of(system).main
    p, q = main.T_world_cam[:, :3, 3], sequence.ground_truth_T_world_cam[main.index][:, :3, 3]
    rmse = float(np.sqrt((distances_when_aligned(p, q) ** 2).mean()))
    breaks = find_silent_breaks(sequence.timestamps_s[main.index], p, q, 1.0 / sequence.rate_hz)
    told = "-" if breaks is None else f"{breaks.broken or 0}/{breaks.judged}"
    share = len(main) / len(frames)
    return (
        f"{world:11s} {seed:5d} gap {gap:2d}  {share:6.1%}  broken {told:5s}"
        f"  submaps {len(system.atlas.submaps)}  {rmse:.4f} m  {found}"
    )


def main() -> None:
    """Run all worlds for all seeds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[101, 102, 103])
    parser.add_argument("--worlds", nargs="+", choices=sorted(FRAMES), default=list(FRAMES))
    arguments = parser.parse_args()
    dualslam.limit_threads()
    for seed in arguments.seeds:
        for world in arguments.worlds:
            print(run(world, seed), flush=True)


if __name__ == "__main__":
    main()
