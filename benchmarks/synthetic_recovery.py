"""Failures scripted into rendered worlds with exact truth: what is recovered, and how true each link is.

    python benchmarks/synthetic_recovery.py --runs 40 --jobs 2 [--half development]

A run is a street (320 x 240 pixels) or a room (640 x 480) of its own seed, with one failure of one kind in the middle.
Each prints a line; a file that holds some runs already is continued. Run k of a kind has the same world, place and seed
always. A link is wrong by the rule as it is written, drift or not. Where one is, the world is run once more without the
failure, and that map, which never broke, is audited at the same frames: what the scale is off by there is drift, and
not the link's doing. Beside it stands what the links are off by over the frames that both maps pose. A lost map is
taken over where all its frames are registered in another one: it is not linked, and nothing of it is missing.

Settings are chosen on the development half (world seeds from 0) and reported on the other (from 10,000).
"""

from __future__ import annotations

import argparse
import json
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dualslam.core.resources import limit_threads

KINDS = ("wrong_pose", "blur", "blackout", "drop", "exposure", "turn")
SCENES = ("street", "room")
SIZE = {"street": (320, 240, 600), "room": (640, 480, 1000)}
"""Width, height, features. In small images of a room a hand moves too little for a map to start within its 8 s."""
SECONDS = {"street": 9.0, "room": 8.0}
FIRST_SEED = {"development": 0, "reporting": 10_000}


def script(kind: str, scene: str, rng: np.random.Generator, n_frames: int, rate_hz: float) -> dict[str, list[Any]]:
    """Return the disturbances of a run: `events` of the world, `corruptions` of the config."""
    start = int(rng.uniform(0.45, 0.6) * n_frames)
    # Longer than tracking waits for a lost map (8 frames), up to 1 s.
    length = int(rng.integers(10, max(11, round(rate_hz)) + 1))
    if kind == "wrong_pose":
        # Forced into keyframe after keyframe, until the map around the camera is wrong.
        level, n = float(rng.uniform(8, 25)), int(rng.integers(1, 6))
        fault = {"kind": "wrong_pose", "start": start, "length": n, "strength": level, "seed": int(rng.integers(1000))}
        return {"events": [], "corruptions": [fault]}
    event: dict[str, Any] = {"start": start, "length": length}
    event |= {
        "blur": {"kind": "blur", "strength": float(rng.uniform(10, 25))},
        "blackout": {"kind": "blackout"},
        "drop": {"kind": "drop"},
        "exposure": {"kind": "exposure", "strength": float(rng.choice([-6.0, 5.0]))},
        "turn": {"kind": "rotation", "strength": float(rng.choice([-1, 1]) * rng.uniform(60, 110))},
    }[kind]
    return {"events": [event], "corruptions": []}


def run_once(job: tuple[str, str, int], settings: dict[str, Any]) -> dict[str, Any]:
    """Run one world, and measure."""
    limit_threads()
    from dualslam.lab.audits.link_audit import LinkAudit, audit_links
    from dualslam.lab.synthetic import make_sequence

    scene, kind, seed = job
    rate_hz = 10.0 if scene == "street" else 30.0
    n_frames = round(SECONDS[scene] * rate_hz)
    rng = np.random.default_rng([seed, KINDS.index(kind), SCENES.index(scene)])
    made = script(kind, scene, rng, n_frames, rate_hz)
    width, height, n_features = SIZE[scene]
    world = make_sequence(scene, n_frames, seed, width, height, events=made["events"])
    values = {"seed": seed, "frontend": {"n_features": n_features}, "corruptions": made["corruptions"]}
    if kind == "wrong_pose":  # the map would refuse it, and nothing would be corrupted
        values["health"] = {"max_refused": 1.0}
    began = time.process_time()
    system = run(world, values | settings)
    cpu_s = time.process_time() - began
    audits = audit_links(system.atlas, system.poses.values(), truth_of(world))
    found = {"scene": scene, "kind": kind, "seed": seed} | measure(system, world, audits, cpu_s)
    links = [audit for audit in audits if isinstance(audit, LinkAudit)]
    found["links"] = [a | b for a, b in zip(found["links"], claimed_sigmas(system, links), strict=True)]
    if any(link.wrong for link in links):
        whole = make_sequence(scene, n_frames, seed, width, height, events=[])
        controls = audit_again(links, run(whole, values | {"corruptions": []} | settings), whole)
        found["links"] = [a | b for a, b in zip(found["links"], controls, strict=True)]
    return found


def run(world: Any, values: dict[str, Any]) -> Any:
    """Return the system that has seen the whole of a world."""
    from dualslam.build import build_system
    from dualslam.core.config.files import config_from_dict

    system = build_system(config_from_dict(values, "synthetic_recovery"), world.camera)
    for frame in world:
        system.step(frame)
    system.finish()
    return system


def truth_of(world: Any) -> dict[int, np.ndarray]:
    """Return the true poses of a world's frames."""
    return dict(enumerate(world.ground_truth_T_world_cam))


def claimed_sigmas(system: Any, links: list[Any]) -> list[dict[str, float]]:
    """Return what each link says that its scale is known to at the live end (standard deviation)."""
    from dualslam.core.events import EventKind

    linked = {(e.data["old_submap"], e.submap): e for e in system.events.of_kind(EventKind.LINKED)}
    return [{"claimed_sigma": linked[link.old, link.new].data["sigma_scale"]} for link in links]


def audit_again(links: list[Any], unbroken: Any, world: Any) -> list[dict[str, float | None]]:
    """Return for each link what the same audit finds in a map that never broke, if that was one map."""
    from dualslam.lab.audits.link_audit import audit_unbroken

    submaps, poses = unbroken.atlas.submaps, unbroken.poses.values()
    is_one = len(submaps) == 1
    T = {p.index: submaps[0].resolve_anchor(p.keyframe_id, p.T_kf_cam) for p in poses} if is_one else {}
    controls = [audit_unbroken(link, T, truth_of(world)) if is_one else None for link in links]
    return [
        {"unbroken_scale": getattr(c, "scale", None), "unbroken_live_scale": getattr(c, "live_scale", None)}
        for c in controls
    ]


def measure(system: Any, world: Any, audits: list[Any], cpu_s: float) -> dict[str, Any]:
    """Return the numbers of a finished run."""
    from dualslam.core.events import EventKind
    from dualslam.lab.audits.map_jumps import find_map_jumps
    from dualslam.lab.metrics.alignment import distances_when_aligned
    from dualslam.run.results import trajectories_of

    truth = truth_of(world)
    main = trajectories_of(system).main
    started = min((i for i in system.poses), default=0)
    possible = [i for i in world.indices.tolist() if i >= started]
    ate_pct = None
    if len(main) >= 10:
        p, q = main.T_world_cam[:, :3, 3], world.ground_truth_T_world_cam[main.index][:, :3, 3]
        path = float(np.linalg.norm(np.diff(q, axis=0), axis=1).sum())
        ate_pct = 100 * float(np.sqrt((distances_when_aligned(p, q) ** 2).mean())) / path
    return {
        "failures": len(system.events.of_kind(EventKind.FAILED)),
        "restarts": len(system.events.of_kind(EventKind.REINITIALISED)),
        "taken over": sum(len(e.data["old_submaps"]) for e in system.events.of_kind(EventKind.REGISTERED)),
        "links": [a.as_dict() for a in audits if hasattr(a, "as_dict")],
        "unaudited": sum(not hasattr(a, "as_dict") for a in audits),
        "refused": [str(e.data.get("reason")) for e in system.events.of_kind(EventKind.LINK_REFUSED)],
        "silent_jumps": sum(
            not jump.noticed for jump in find_map_jumps(system.atlas, system.poses.values(), truth, system.events)
        ),
        "lost_after_fusion": sum(
            row.status == "lost" and 0 < row.index - event.frame <= world.rate_hz
            for event in system.events.of_kind(EventKind.FUSED)
            for row in system.rows.values()
        ),
        "coverage": len(main) / max(len(possible), 1),
        "ate_pct": ate_pct,
        "cpu_s": cpu_s,
    }


def is_drift(link: dict[str, Any]) -> bool:
    """Whether a link's scale is no more than 5 % off from what the map that never broke says of the same places."""
    from dualslam.lab.audits.link_audit import WRONG_POSITION, WRONG_ROTATION_DEG, WRONG_SCALE

    if link["rotation_deg"] > WRONG_ROTATION_DEG or link["position"] > WRONG_POSITION:
        return False
    pairs = [(link["scale"], link["unbroken_scale"]), (link["live_scale"], link["unbroken_live_scale"])]
    known = [(found, control) for found, control in pairs if found is not None and control is not None]
    return bool(known) and all(abs(np.log1p(found) - np.log1p(control)) <= WRONG_SCALE for found, control in known)


def table(runs: list[dict[str, Any]]) -> str:
    """Return the results by kind of failure, as Markdown."""
    lines = [
        "| scene | failure | runs | lost maps | with a new map | linked | taken over | wrong | of these beyond drift "
        "| scale % med / max | rotation deg med / max | position % med / max | live scale % med / max "
        "| over its sigma, rms | scale % where both maps are, rms / max "
        "| ATE % med | silent jumps | frames lost within 1 s of a fusion |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    groups = [(s, k) for s in SCENES for k in KINDS] + [("all", "all")]
    for scene, kind in groups:
        of = [r for r in runs if scene == "all" or (r["scene"], r["kind"]) == (scene, kind)]
        if not of:
            continue
        links = [link for r in of for link in r["links"]]
        cells = [scene, kind, len(of), sum(r["failures"] for r in of), sum(r["restarts"] for r in of), len(links)]
        cells.append(sum(r["taken over"] for r in of))
        cells += [sum(link["wrong"] for link in links), sum(link["wrong"] and not is_drift(link) for link in links)]
        for name, factor in (("scale", 100), ("rotation_deg", 1), ("position", 100), ("live_scale", 100)):
            values = [factor * abs(link[name]) for link in links if link[name] is not None]
            cells.append(f"{np.median(values):.2f} / {max(values):.2f}" if values else "-")
        ratio = [link["live_scale"] / link["claimed_sigma"] for link in links if link["live_scale"] is not None]
        cells.append(f"{np.sqrt(np.mean(np.square(ratio))):.1f}" if ratio else "-")
        shared = [100 * link["shared_scale"] for link in links if link["shared_scale"] is not None]
        cells.append(f"{np.sqrt(np.mean(np.square(shared))):.2f} / {np.abs(shared).max():.2f}" if shared else "-")
        ate = [r["ate_pct"] for r in of if r["ate_pct"] is not None]
        cells.append(f"{np.median(ate):.2f}" if ate else "-")
        cells += [sum(r[name] for r in of) for name in ("silent_jumps", "lost_after_fusion")]
        lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Run what is missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=17, help="runs of each scene and kind of failure")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--only", action="append", choices=(*KINDS, *SCENES), help="these kinds, or scenes, only")
    parser.add_argument("--set", type=json.loads, default={}, help="config values as JSON, over the script's own")
    parser.add_argument(
        "--half", choices=tuple(FIRST_SEED), default="reporting", help="which worlds (default: reporting)"
    )
    parser.add_argument("--out", type=Path, help="default: runs/synthetic_recovery_HALF.jsonl")
    args = parser.parse_args()
    args.out = args.out or Path(f"runs/synthetic_recovery_{args.half}.jsonl")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    text = args.out.read_text() if args.out.exists() else ""
    runs = [json.loads(line) for line in text.splitlines()]
    done = {(r["scene"], r["kind"], r["seed"]) for r in runs}
    seeds = range(FIRST_SEED[args.half], FIRST_SEED[args.half] + args.runs)
    wanted = [(s, k, n) for n in seeds for s in SCENES for k in KINDS]
    for choices in (KINDS, SCENES):
        if only := set(args.only or ()) & set(choices):
            wanted = [job for job in wanted if not only.isdisjoint(job[:2])]
    missing = [job for job in wanted if job not in done]
    with ProcessPoolExecutor(args.jobs) as pool, args.out.open("a") as out:
        for result in pool.map(partial(run_once, settings=args.set), missing):
            runs.append(result)
            out.write(json.dumps(result) + "\n")
            out.flush()
            short = {name: result[name] for name in ("scene", "kind", "seed", "failures", "restarts", "coverage")}
            print(json.dumps(short | {"links": [round(link["scale"], 4) for link in result["links"]]}), flush=True)
    print(table(runs))


if __name__ == "__main__":
    main()
