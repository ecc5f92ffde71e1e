"""Gaps of 2 and 4 s in sharp turns, without and with a gyroscope: 40 losses, joined right, joined wrong or not joined.

    python benchmarks/gaps_in_turns.py [--half development] [--data DIR] [--only SCENE ...] [--runs N] [--out FILE]

36 are in rendered worlds (320 x 240 pixels, 10 Hz), 4 in `kitti_03` under --data. A clip has 6 s before its gap and 6 s
after it; the gap is put where the camera turns most within it. The gyroscope is simulated as a phone's has it: 0.005
rad/s of noise in each reading at 100 Hz, a bias of 0.01 rad/s along each axis (standard deviation), its mount known.
A join is judged by `audit_join`. FILE holds the runs that are made; it is continued.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dualslam.core.threads import limit_threads

limit_threads()

import numpy as np  # noqa: E402

from dualslam.core.geometry import so3  # noqa: E402
from dualslam.core.trajectory import Trajectory  # noqa: E402

SCENES = ("circuit", "eight", "street")
SEEDS = {"development": (1, 2, 3), "reporting": (20_001, 20_002, 20_003)}
"""Of the worlds; each has both gaps."""
KITTI_PLACES = 2
"""Apart by a gap and a side; one for each half."""
SIDE_S, GAPS_S = 6.0, (2.0, 4.0)
BIAS_SIGMA_RAD_S = 0.01


@dataclass(frozen=True)
class Case:
    """A clip with a gap."""

    scene: str
    seed: int  # of the world and of the gyroscope; of a recording: which of its places
    gap_s: float

    @property
    def name(self) -> str:
        """A word for it."""
        return f"{self.scene}_{self.seed}_{self.gap_s:g}s"


def cases(half: str, with_kitti: bool) -> Iterator[Case]:
    """Yield the cases of a half."""
    for seed in SEEDS[half]:
        for scene in SCENES:
            yield from (Case(scene, seed, gap_s) for gap_s in GAPS_S)
    for place in range(KITTI_PLACES if with_kitti else 0):
        if (place % 2 == 0) == (half == "development"):
            yield from (Case("kitti_03", place, gap_s) for gap_s in GAPS_S)


def sharpest(truth: Trajectory, gap_s: float, rank: int) -> tuple[int, int, float]:
    """Return the first frame of a gap, the first behind it, and the turn within, in degrees."""
    t, R = truth.timestamps_s, truth.T_world_cam[:, :3, :3]
    first = np.searchsorted(t, t[0] + SIDE_S)
    end = np.searchsorted(t, t[-1] - SIDE_S - gap_s)
    starts = np.arange(first, end)
    after = np.searchsorted(t, t[starts] + gap_s - 1e-6)
    turns = np.linalg.norm(so3.log(R[starts - 1].swapaxes(1, 2) @ R[after]), axis=1)
    for _ in range(rank):
        near = np.abs(t[starts] - t[starts[turns.argmax()]]) < gap_s + SIDE_S
        turns = np.where(near, -1.0, turns)
    best = int(turns.argmax())
    return int(starts[best]), int(after[best]), float(np.degrees(turns[best]))


def run_case(case: Case, data: Path | None, with_gyroscope: bool) -> dict[str, Any]:
    """Run a clip, and judge its join."""
    from dualslam.build import build_system
    from dualslam.core.config.files import config_from_dict
    from dualslam.lab.audits.join_audit import audit_join
    from dualslam.lab.synthetic import make_sequence
    from dualslam.run.results import trajectories_of
    from dualslam.run.sources import open_source

    values: dict[str, Any] = {"seed": 1}
    if case.scene == "kitti_03":
        assert data is not None
        source: Any = open_source(data / case.scene)
        truth = source.ground_truth
    else:
        source = make_sequence(case.scene, 220, case.seed, 320, 240)
        truth = Trajectory(source.timestamps_s, source.ground_truth_T_world_cam)
        values["frontend"] = {"n_features": 600}
    first, after, turn_deg = sharpest(truth, case.gap_s, case.seed if case.scene == "kitti_03" else 0)
    n_side = round(SIDE_S / float(np.median(np.diff(truth.timestamps_s))))
    begin, end = first - n_side, after + n_side
    began = time.process_time()
    prior = gyroscope(case, truth) if with_gyroscope else None
    system = build_system(config_from_dict(values, "gaps_in_turns"), source.camera, prior=prior)
    for frame in frames_between(source, begin, end):
        if not first <= frame.index < after:
            system.step(frame)
    system.finish()
    main = trajectories_of(system).main
    join = audit_join(main.index, main.T_world_cam, truth.T_world_cam[main.index], first, after)
    events = [str(e.event) for e in system.events if str(e.event) in TOLD]
    refused = [str(e.data.get("reason")) for e in system.events if str(e.event) == "link_refused"]
    found = {"case": case.name, "gyroscope": with_gyroscope, "outcome": str(join.outcome), "turn_deg": round(turn_deg)}
    sizes = {"n_before": join.n_before, "n_after": join.n_after, "offset_m": join.offset_m, "scale": join.scale_ratio}
    return found | sizes | {"events": events, "refused": refused, "cpu_s": round(time.process_time() - began, 1)}


TOLD = ("failed", "reinitialised", "linked", "merged", "relocalised", "gap_relocalised", "link_refused", "absorbed")


def frames_between(source: Any, begin: int, end: int) -> Iterator[Any]:
    """Yield the frames of a source with these numbers."""
    if hasattr(source, "frame"):
        yield from (source.frame(i) for i in range(begin, end))
        return
    for frame in source:
        if frame.index >= end:
            return
        if frame.index >= begin:
            yield frame


def gyroscope(case: Case, truth: Trajectory) -> Any:
    """Return what a phone's gyroscope knows of the camera's turns."""
    from dualslam.build.parts import measurement_sources, motion_prior
    from dualslam.core.metric_problem import MeasurementRow
    from dualslam.lab.simulated_measurements import Gyroscope

    bx, by, bz = np.random.default_rng(case.seed).normal(0.0, BIAS_SIGMA_RAD_S, 3).tolist()
    source = Gyroscope(bias_rad_s=(bx, by, bz), seed=case.seed).rates(truth)
    mount = MeasurementRow("mount", (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), "simulated")
    return motion_prior(measurement_sources([replace(source, rows=[mount, *source.rows])]))


def table(runs: list[dict[str, Any]]) -> str:
    """Return the counts as Markdown."""
    lines = ["| scene | gap | losses | joined right, wrong, not: without | with |", "|---|---|---|---|---|"]
    kinds = sorted({(r["case"].rsplit("_", 2)[0], r["case"].rsplit("_", 1)[1]) for r in runs})
    for scene, gap in [*kinds, ("all", "all")]:
        of = [r for r in runs if scene == "all" or (r["case"].startswith(scene) and r["case"].endswith(gap))]
        cells = []
        for with_it in (False, True):
            outcomes = [r["outcome"] for r in of if r["gyroscope"] is with_it]
            cells.append(", ".join(str(outcomes.count(each)) for each in ("right", "wrong", "not joined")))
        lines.append(f"| {scene} | {gap} | {len({r['case'] for r in of})} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Make the runs that are missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--half", choices=tuple(SEEDS), default="reporting")
    parser.add_argument("--data", type=Path, help="folder with kitti_03")
    parser.add_argument("--only", nargs="+", default=[])
    parser.add_argument("--runs", type=int, help="make at most so many now")
    parser.add_argument("--out", type=Path, default=Path("runs/gaps_in_turns.jsonl"))
    args = parser.parse_args()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    runs = [json.loads(line) for line in args.out.read_text().splitlines()] if args.out.exists() else []
    done = {(r["case"], r["gyroscope"]) for r in runs}
    wanted = [c for c in cases(args.half, args.data is not None) if not args.only or c.scene in args.only]
    missing = [(c, with_it) for c in wanted for with_it in (False, True) if (c.name, with_it) not in done]
    for case, with_it in missing[: args.runs]:
        runs.append(run_case(case, args.data, with_it))
        print(json.dumps(runs[-1]), flush=True)
        with args.out.open("a") as out:
            out.write(json.dumps(runs[-1]) + "\n")
    print(table(runs))


if __name__ == "__main__":
    main()
