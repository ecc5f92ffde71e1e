"""How long a recovery takes, and what it costs the camera's frames meanwhile, on real sequences in real time.

    python benchmarks/recoveries.py [SEQUENCE ...] [--places 3] [--half development] [--out runs/recoveries]

At each place of a sequence a clip is disturbed twice: ten black frames, and a gap (0.5, 1 and 1.5 s by turns in which
no frame arrives). Each runs with `--realtime --workers 1`, and once more with recovery off: the same young map, the
same frames, and nothing beside them. Printed are, for each loss, the seconds that the walk took which made the link,
the seconds of the stream from the new map's start to the link, and from the first frame after the disturbance until
the map is one again, by a link or as it was seen again; the attempts before it, and the median latency of the frames
that came during recoveries over that of the same frames without. It says something only where nothing else computes.

Without sequences: kitti_03 and 7scenes_1000 under the folder that DUALSLAM_DATA names. Places of the two halves differ.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import statistics
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dualslam.run.sources import open_source

BEFORE, AFTER = 90, 90
"""Frames of a clip before its disturbance, and after it."""
JOINED = ("linked", "merged", "relocalised")
"""Events with which a lost map goes on."""
BLACK_FRAMES = 10
GAPS_S = (0.5, 1.0, 1.5)
HALVES = {"development": 0.0, "reporting": 0.5}
"""By which share of the distance between two places those of a half are moved."""


@dataclass(frozen=True)
class Loss:
    """One disturbed clip, and what became of it.

    `walk_s` and `stream_s` are None where no link was made; `joined_s` where none was, and the map was not seen again.
    """

    kind: str
    at: int
    attempts: int
    walk_s: float | None
    stream_s: float | None
    joined_s: float | None
    latency_ratio: float | None
    lost: bool


def main() -> None:
    """Disturb every sequence at every place, and print a row for each loss and a median for each kind."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="*")
    parser.add_argument("--places", type=int, default=3)
    parser.add_argument("--half", choices=tuple(HALVES), default="reporting")
    parser.add_argument("--out", type=Path, default=Path("runs/recoveries"))
    args = parser.parse_args()
    print("| sequence | disturbance | at frame | attempts | walk s | after the new map's start, s", end=" ")
    print("| one map after the disturbance, s | latency ratio |\n|---|---|---|---|---|---|---|---|")
    losses: list[Loss] = []
    for sequence in args.sequences or _default_sequences():
        losses += [_row(sequence, loss) for loss in _losses_of(sequence, args)]
    for kind in ("black", "gap"):
        _print_medians(kind, [loss for loss in losses if loss.kind.startswith(kind) and loss.lost])


def _default_sequences() -> list[str]:
    data = os.environ.get("DUALSLAM_DATA")
    if not data:
        sys.exit("no sequence is named, and DUALSLAM_DATA names no folder of them")
    return [str(Path(data) / name) for name in ("kitti_03", "7scenes_1000")]


def _losses_of(sequence: str, args: argparse.Namespace) -> list[Loss]:
    times = [frame.timestamp_s for frame in open_source(sequence)]
    rate_hz = (len(times) - 1) / (times[-1] - times[0])
    step = (len(times) - BEFORE - AFTER - round(max(GAPS_S) * rate_hz)) / args.places
    losses = []
    for place in range(args.places):
        at = BEFORE + round((place + HALVES[args.half]) * step)
        gap_s = GAPS_S[place % len(GAPS_S)]
        for kind, script in (
            (f"black, {BLACK_FRAMES} frames", {"kind": "blackout", "start": at, "length": BLACK_FRAMES}),
            (f"gap, {gap_s} s", {"kind": "drop", "start": at, "length": round(gap_s * rate_hz)}),
        ):
            losses.append(_measured(sequence, kind, at, script, args.out))
    return losses


def _measured(sequence: str, kind: str, at: int, script: dict[str, Any], out: Path) -> Loss:
    name = f"{Path(sequence).name}_{script['kind']}_{at}"
    out.mkdir(parents=True, exist_ok=True)
    corruption = out / f"{name}.yaml"
    corruption.write_text(json.dumps([script]))
    clip = ["--start", str(at - BEFORE), "--max-frames", str(BEFORE + script["length"] + AFTER)]
    options = [*clip, "--corrupt", str(corruption), "--realtime", "--workers", "1"]
    with_it, without = out / name, out / f"{name}_off"
    _run(sequence, with_it, options)
    _run(sequence, without, [*options, "--no-recovery"])
    return _read(kind, at, script["length"], with_it, without)


def _run(sequence: str, folder: Path, options: list[str]) -> None:
    command = [sys.executable, "-m", "dualslam.cli", "run", sequence, "--out", str(folder), "--overwrite", "--quiet"]
    done = subprocess.run([*command, *options], check=False)
    if done.returncode not in (0, 1):
        sys.exit(done.returncode)


def _read(kind: str, at: int, length: int, folder: Path, without: Path) -> Loss:
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    started = [e for e in events if e["event"] == "recovery_started"]
    ended = [e for e in events if e["event"] == "recovery_ended"]
    linked = next((e for e in events if e["event"] == "linked"), None)
    walk = next((e for e in ended if e["linked"]), None)
    start = next((e for e in events if e["event"] == "reinitialised"), None)
    joined = next((e for e in events if e["event"] in JOINED), None)
    during = {
        frame
        for first, last in zip(started, ended, strict=False)
        for frame in range(first["frame"] + 1, last["frame"] + 1)
    }
    return Loss(
        kind,
        at,
        attempts=len(ended),
        walk_s=None if linked is None or walk is None else float(walk["seconds"]),
        stream_s=None if linked is None or start is None else float(linked["timestamp_s"] - start["timestamp_s"]),
        joined_s=None if joined is None else float(joined["timestamp_s"] - _time_of(folder, at + length)),
        latency_ratio=_latency_ratio(folder, without, during),
        lost=any(e["event"] == "failed" for e in events),
    )


def _time_of(folder: Path, frame: int) -> float:
    with (folder / "frames.csv").open() as file:
        return next(float(row["timestamp_s"]) for row in csv.DictReader(file) if int(row["index"]) >= frame)


def _latency_ratio(folder: Path, without: Path, during: set[int]) -> float | None:
    with_it, baseline = _latencies(folder), _latencies(without)
    frames = sorted(during & with_it.keys() & baseline.keys())
    if len(frames) < 5:
        return None
    return statistics.median(with_it[i] for i in frames) / statistics.median(baseline[i] for i in frames)


def _latencies(folder: Path) -> dict[int, float]:
    with (folder / "frames.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["status"] == "tracked"]
    return {int(row["index"]): float(row["latency_ms"]) for row in rows}


def _row(sequence: str, loss: Loss) -> Loss:
    made = "not lost" if not loss.lost else loss.attempts
    numbers = (loss.walk_s, loss.stream_s, loss.joined_s, loss.latency_ratio)
    cells = (Path(sequence).name, loss.kind, loss.at, made, *map(_number, numbers))
    print("| " + " | ".join(map(str, cells)) + " |", flush=True)
    return loss


def _print_medians(kind: str, losses: list[Loss]) -> None:
    linked = [loss for loss in losses if loss.walk_s is not None]
    print(f"\n{kind}: {len(linked)} of {len(losses)} losses linked", end="")
    for what, values in (
        ("walk s", [loss.walk_s for loss in linked]),
        ("after the new map's start, s", [loss.stream_s for loss in linked]),
        ("one map after the disturbance, s", [loss.joined_s for loss in losses]),
        ("latency ratio", [loss.latency_ratio for loss in losses]),
    ):
        told = [value for value in values if value is not None]
        if told:
            print(f"; {what}: median {statistics.median(told):.2f}, worst {max(told):.2f} of {len(told)}", end="")
    print()


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


if __name__ == "__main__":
    main()
