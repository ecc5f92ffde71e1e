"""Runs in a world of points under schedules drawn at random, each judged against the same run with answers at once.

    python benchmarks/random_schedules.py --first 0 --n 100

From its seed a schedule draws the losses of the run (one to three) and a delay for each kind of background job. In a
third of the schedules workers die or hang. One line of JSON a schedule: frames without a pose in the main map,
largest error of a position, and the same of the run at once. `is_worse`: it errs by more than half as much again, or
misses frames that this one has though no job was lost; then the exit status is 1. A map whose jobs are lost may know
its scale too badly for a link. `--twice`: each is made again, and must repeat to the bit.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np

from dualslam.core.jobs import JobKind
from dualslam.core.schedule import DELAYS, After
from dualslam.core.types import FailureReason, FloatArray
from dualslam.run.results import trajectories_of
from dualslam.testing.lossy import Lossy
from dualslam.testing.point_world import PointWorld, cloud, hand_held, pose_errors, system_in

FRAMES = (60, 80, 110)
SPEED = 0.6
"""Of the camera: slow enough that the two sides of a gap show much the same, and no link is refused as ambiguous."""
DRAWN_DELAYS = (0, 1, 5, 20, math.inf)
DENSE: dict[str, Any] = {"keyframes": {"max_parallax_deg": 1.0}, "mapping": {"redundant_ratio": 1.0}}
SMALL: dict[str, Any] = {"graph": {"max_keyframes": 20, "rollover_keyframes": 6}}
SAME_ERROR, LEAST_ERROR_M = 1.5, 0.12
"""Errors that count as the same: seeds of the noise make as much of a difference."""


@dataclass(frozen=True)
class Drawn:
    """A run and a schedule.

    Attributes
    ----------
    seed, n_frames : int
    covered : frozenset of int
        Frames that show nothing.
    rolls_over : bool
        Whether submaps are small.
    delays : dict of JobKind to float
    lost_every : int
        Of so many jobs of a kind one is lost; 0: none.
    hangs : bool
        Whether it is lost to a worker that hangs, and not to one that dies.
    """

    seed: int
    n_frames: int
    covered: frozenset[int]
    rolls_over: bool
    delays: dict[JobKind, float]
    lost_every: int
    hangs: bool

    @classmethod
    def of(cls, seed: int) -> Drawn:
        """Draw them."""
        rng = np.random.default_rng([seed, 77])
        n, covered, at = int(rng.choice(FRAMES)), set[int](), int(rng.integers(24, 36))
        for _ in range(3):
            if at >= n - 16:
                break
            length = int(rng.integers(9, 13))
            covered |= set(range(at, at + length))
            at += length + int(rng.integers(6, 40))
        manner = int(rng.integers(3))
        one = float(rng.choice(DRAWN_DELAYS))
        delays = {kind: one if manner == 0 else float(rng.choice(DRAWN_DELAYS)) for kind in DELAYS}
        lost_every = int(rng.choice([3, 5, 9])) if manner == 2 else 0
        return cls(seed, n, frozenset(covered), rng.random() < 0.3, delays, lost_every, rng.random() < 0.5)


@dataclass(frozen=True)
class Made:
    """What a run came to."""

    index: list[int]
    T_world_cam: FloatArray
    n_missing: int
    max_error_m: float
    n_lost_jobs: int


def made(drawn: Drawn, at_once: bool = False) -> Made:
    """Make a run; `at_once`: with answers at once, and no worker that dies."""
    world = PointWorld(cloud(), hand_held(drawn.n_frames, SPEED), covered=drawn.covered, seed=drawn.seed)
    settings = DENSE | (SMALL if drawn.rolls_over else {}) | {"seed": drawn.seed}
    if at_once:
        system = system_in(world, recovery={"enabled": True}, **settings)
    else:
        system = system_in(world, After(drawn.delays), recovery={"enabled": True, "workers": 1}, **settings)
    reason = FailureReason.TIMEOUT if drawn.hangs else FailureReason.WORKER
    lossy = Lossy(list(DELAYS), max(drawn.lost_every, 1), drawn.seed, reason)
    if drawn.lost_every and not at_once:
        system.desk.executor = lossy.around(system.desk.executor)
    for frame in world.frames():
        system.step(frame)
    system.finish()
    for submap in system.atlas.submaps.values():
        if not submap.keyframes.keys() == submap.T_submap_kf.keys() == submap.landmark_of.keys():
            raise RuntimeError(f"submap {submap.id} is not consistent")
    main = trajectories_of(system).main
    index = main.index.tolist()
    translation, _ = pose_errors(main.T_world_cam, world.T_world_cam[index])
    missing = set(range(drawn.n_frames)) - drawn.covered - set(index)
    return Made(index, main.T_world_cam, len(missing), float(translation.max()), lossy.n_lost)


def judged(drawn: Drawn, twice: bool) -> dict[str, Any]:
    """Make a run and say how it compares; the run at once is made where it may have to be excused."""
    told: dict[str, Any] = {"seed": drawn.seed, "frames": drawn.n_frames, "covered": len(drawn.covered)}
    told |= {"rolls_over": drawn.rolls_over, "lost_every": drawn.lost_every, "hangs": drawn.hangs}
    told["delays"] = {str(kind): None if math.isinf(delay) else delay for kind, delay in drawn.delays.items()}
    run = made(drawn)
    told |= {"missing": run.n_missing, "max_error_m": round(run.max_error_m, 4), "lost_jobs": run.n_lost_jobs}
    told["is_worse"] = run.n_missing > 0 or run.max_error_m > LEAST_ERROR_M
    if told["is_worse"]:
        best = made(drawn, at_once=True)
        told["at_once"] = {"missing": best.n_missing, "max_error_m": round(best.max_error_m, 4)}
        limit_m = max(LEAST_ERROR_M, SAME_ERROR * best.max_error_m)
        misses_more = run.n_missing > best.n_missing and not run.n_lost_jobs
        told["is_worse"] = misses_more or run.max_error_m > limit_m
    if twice:
        again = made(drawn)
        told["repeats"] = again.index == run.index and np.array_equal(again.T_world_cam, run.T_world_cam)
    return told


def main() -> None:
    """Make all runs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--n", type=int, default=20)
    parser.add_argument("--twice", action="store_true")
    args = parser.parse_args()
    failed = False
    for seed in range(args.first, args.first + args.n):
        told = judged(Drawn.of(seed), args.twice)
        failed |= told["is_worse"] or not told.get("repeats", True)
        print(json.dumps(told), flush=True)
    sys.exit(int(failed))


if __name__ == "__main__":
    main()
