"""Loops in rendered worlds with exact truth: which are closed, which are false, and what they do to the error.

    python benchmarks/loops.py --runs 20 --jobs 2 [--half development]

Circuits (a block of houses) and figures of eight are driven for somewhat more than a lap, so that the last frames show
what the first ones showed. A terrace, where all houses are the same, never comes back, nor do two corridors that are
alike or two rooms with the same posters: each of their loops is false. A world is rendered once and run with loops and
without. A line for each; a file that holds some is continued.

A loop is false where the two frames share less than a tenth of what they see, by the true depths.

Settings are chosen on the development half (world seeds from 0) and reported on the other (from 10,000).
"""

from __future__ import annotations

import argparse
import json
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from dualslam.core.resources import limit_threads
from dualslam.core.types import FloatArray

FRAMES = {"circuit": 400, "eight": 800, "terrace": 300, "corridors": 470, "posters": 430}
"""A lap of the block is 204 m and one of the eight 422 m, at some 0.64 m a frame; the corridors take 31 m and the rooms
11, at 0.07 and 0.03."""
SIZE = (320, 240, 600)
"""Width, height, features."""
FIRST_SEED = {"development": 0, "reporting": 10_000}
APART, AWAY_M = 60, 20.0
"""Frames between two visits, and the way: who stands before a wall for two seconds has not come back to it."""
SHARED, SHARED_FALSE = 0.4, 0.1
"""Share of a view that the other must show to be a loop that should be found; and below which it is none."""


def shared(world: Any, a: int, b: int) -> float:
    """Return the share of frame a's pixels (on a grid, sky left out) that lie in frame b's image, as far as b sees."""
    columns, rows = np.meshgrid(np.arange(8, SIZE[0], 16), np.arange(8, SIZE[1], 16))
    points = world.points_world(a, np.stack([columns.ravel(), rows.ravel()], 1))
    points = points[np.isfinite(points).all(axis=1)]
    T_cam_world = np.linalg.inv(world.ground_truth_T_world_cam[b])
    in_b = points @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
    ahead = in_b[in_b[:, 2] > 0.1]
    uv = ahead @ world.camera.K.T
    uv = uv[:, :2] / uv[:, 2:]
    inside = ((uv >= 0) & (uv <= np.array(SIZE[:2]) - 1)).all(axis=1)
    seen = ahead[inside]
    at = np.rint(uv[inside]).astype(int)
    depth = world.depth(b)[at[:, 1], at[:, 0]] if len(seen) else np.zeros(0)
    visible = np.abs(seen[:, 2] - depth) < 0.05 * seen[:, 2]
    return float(np.count_nonzero(visible) / max(len(points), 1))


def revisits(world: Any) -> int:
    """Return how many frames (every fifth looked at) show what a frame long before showed."""
    T = world.ground_truth_T_world_cam
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1))])
    found = 0
    for j in range(APART, len(T), 5):
        earlier = np.linalg.norm(T[: j - APART, :3, 3] - T[j, :3, 3], axis=1)
        earlier[way[: j - APART] > way[j] - AWAY_M] = np.inf
        ahead = T[: j - APART, :3, 2] @ T[j, :3, 2] > 0.7
        near = np.flatnonzero((earlier < 15) & ahead)
        if len(near):
            i = int(near[np.argmin(earlier[near])])
            found += 5 * (min(shared(world, i, j), shared(world, j, i)) >= SHARED)
    return found


def run(world: Any, frames: list[Any], seed: int, loops: bool, settings: dict[str, Any]) -> tuple[Any, float]:
    """Return the system that has seen all frames, and its CPU time in seconds."""
    from dualslam.build import build_system
    from dualslam.core.config.files import config_from_dict

    values = {"seed": seed, "frontend": {"n_features": SIZE[2]}, "loops": {"enabled": loops}}
    system = build_system(config_from_dict(values | settings, "loops"), world.camera)
    began = time.process_time()
    for frame in frames:
        system.step(frame)
    system.finish()
    return system, time.process_time() - began


def ate(system: Any, T_true: FloatArray) -> tuple[float, float]:
    """Return the error in metres (Sim(3) alignment) and the share of the frames in the map."""
    from dualslam.lab.metrics.alignment import distances_when_aligned
    from dualslam.run.results import trajectories_of

    main = trajectories_of(system).main
    if len(main) < 10:
        return float("nan"), len(main) / len(T_true)
    p, q = main.T_world_cam[:, :3, 3], T_true[main.index][:, :3, 3]
    return float(np.sqrt((distances_when_aligned(p, q) ** 2).mean())), len(main) / len(T_true)


def run_once(job: tuple[str, int], settings: dict[str, Any]) -> dict[str, Any]:
    """Run one world with loops and without, and measure."""
    limit_threads()
    from dualslam.core.events import EventKind
    from dualslam.lab.synthetic import make_sequence

    scene, seed = job
    world = make_sequence(scene, FRAMES[scene], seed, *SIZE[:2])
    frames = list(world)
    T = world.ground_truth_T_world_cam
    system, cpu_s = run(world, frames, seed, True, settings)
    plain, plain_cpu_s = run(world, frames, seed, False, settings)
    closed = [
        (e.frame, int(e.data["other_frame"])) for e in system.events.of_kind(EventKind.LOOP_CLOSED, EventKind.MERGED)
    ]
    overlap = [max(shared(world, a, b), shared(world, b, a)) for a, b in closed]
    (error, coverage), (plain_error, _) = ate(system, T), ate(plain, T)
    return {
        "scene": scene,
        "seed": seed,
        "revisits": revisits(world),
        "closed": closed,
        "shared": overlap,
        "false": sum(share < SHARED_FALSE for share in overlap),
        "refused": [str(e.data.get("reason")) for e in system.events.of_kind(EventKind.LOOP_REFUSED)],
        "rejected": len(system.events.of_kind(EventKind.CONNECTION_REJECTED)),
        "coverage": coverage,
        "ate_m": error,
        "ate_without_m": plain_error,
        "cpu_s": cpu_s,
        "cpu_without_s": plain_cpu_s,
    }


def table(runs: list[dict[str, Any]]) -> str:
    """Return the results by world, as Markdown."""
    lines = [
        "| world | runs | with a revisit | closed there | loops | false | ATE m, median | without loops "
        "| ratio, median | CPU, ratio |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for scene in FRAMES:
        of = [r for r in runs if r["scene"] == scene]
        if not of:
            continue
        chance = [r for r in of if r["revisits"] >= 10]
        ratio = [r["ate_m"] / r["ate_without_m"] for r in chance]
        cells = [scene, len(of), len(chance), sum(bool(r["closed"]) for r in chance)]
        cells += [sum(len(r["closed"]) for r in of), sum(r["false"] for r in of)]
        cells += [f"{np.nanmedian([r[name] for r in of]):.3f}" for name in ("ate_m", "ate_without_m")]
        cells.append(f"{np.nanmedian(ratio):.2f}" if ratio else "-")
        cells.append(f"{np.median([r['cpu_s'] / r['cpu_without_s'] for r in of]):.2f}")
        lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Run what is missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5, help="runs of each world")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--only", action="append", choices=tuple(FRAMES), help="worlds to run")
    parser.add_argument("--set", type=json.loads, default={}, help="config values as JSON, over the script's own")
    parser.add_argument("--half", choices=tuple(FIRST_SEED), default="reporting")
    parser.add_argument("--out", type=Path, help="default: runs/loops_HALF.jsonl")
    args = parser.parse_args()
    out_path = args.out or Path(f"runs/loops_{args.half}.jsonl")
    out_path.parent.mkdir(parents=True, exist_ok=True)
    text = out_path.read_text() if out_path.exists() else ""
    runs = [json.loads(line) for line in text.splitlines()]
    done = {(r["scene"], r["seed"]) for r in runs}
    seeds = range(FIRST_SEED[args.half], FIRST_SEED[args.half] + args.runs)
    wanted = [(scene, n) for n in seeds for scene in args.only or FRAMES]
    with ProcessPoolExecutor(args.jobs) as pool, out_path.open("a") as out:
        jobs = [pool.submit(run_once, job, args.set) for job in wanted if job not in done]
        for job in jobs:
            runs.append(job.result())
            out.write(json.dumps(runs[-1]) + "\n")
            out.flush()
            print(json.dumps({k: v for k, v in runs[-1].items() if k not in ("shared", "refused")}), flush=True)
    print(table(runs))


if __name__ == "__main__":
    main()
