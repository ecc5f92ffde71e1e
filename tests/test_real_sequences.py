"""Short clips of real sequences: what a person would see first, of which no synthetic world tells.

`DUALSLAM_DATA` names the folder of the sequences. Bounds on the error are about three times what one run has; a map
that is wrong misses them by far (a camera that never moved would have the spread that stands beside them).
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dualslam.cli import main

pytestmark = [
    pytest.mark.data,
    pytest.mark.slow,
    pytest.mark.skipif("DUALSLAM_DATA" not in os.environ, reason="DUALSLAM_DATA names no folder of real sequences"),
]

BLACKOUT = "- {kind: blackout, start: 90, length: 9}\n"


def run(out: Path, sequence: str, *options: str) -> dict[str, Any]:
    folder = Path(os.environ["DUALSLAM_DATA"]) / sequence
    if not folder.is_dir():
        pytest.skip(f"DUALSLAM_DATA has no {sequence}")
    assert main(["run", str(folder), "--out", str(out), "--seed", "1", "--quiet", *options]) == 0
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return summary


@pytest.mark.parametrize(
    ("sequence", "start", "frames", "max_ate_m"),
    [
        ("kitti_03", 0, 60, 0.15),  # spread 13.8 m
        ("7scenes_1000", 0, 60, 0.015),  # 0.079 m
        ("tum_fr1_rpy", 420, 150, 0.02),  # 0.053 m
        ("hololens_000", 20, 60, 0.09),  # 1.27 m
    ],
)
def test_a_clip_is_posed_whole_and_right(
    tmp_path: Path, sequence: str, start: int, frames: int, max_ate_m: float
) -> None:
    summary = run(tmp_path / "run", sequence, "--start", str(start), "--max-frames", str(frames))
    assert summary["frames"] == frames
    assert summary["coverage"] >= 0.95
    assert summary["failures"] == 0
    assert summary["ate_rmse_m"] <= max_ate_m


def test_a_black_out_on_the_road_ends_in_one_map(tmp_path: Path) -> None:
    (tmp_path / "blackout.yaml").write_text(BLACKOUT)
    out = tmp_path / "run"
    summary = run(out, "kitti_03", "--max-frames", "160", "--corrupt", str(tmp_path / "blackout.yaml"))
    assert (summary["failures"], summary["recoveries"], summary["links"]) == (1, 1, 1)
    assert summary["coverage"] >= 0.93  # nine black frames of 160 show nothing
    assert summary["ate_rmse_m"] <= 0.6
    posed = {line.split()[0] for line in (out / "trajectory.txt").read_text().splitlines() if line[0] != "#"}
    assert len(posed) == round(summary["coverage"] * summary["frames"])


def test_two_floors_that_look_alike_are_not_one(tmp_path: Path) -> None:
    """Down a staircase, from one floor past the next. Merged, the camera moves by a floor between two frames."""
    out = tmp_path / "run"
    clip = ("--start", "45", "--max-frames", "175", "--set", "recovery.attempts=[live]")
    run(out, "phone_staircase", "--inline", *clip)
    refused = [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines() if "loop_refused" in line]
    assert any(event["reason"] == "leap" for event in refused), "the floors have been taken for one another"
    trajectory = np.loadtxt(out / "trajectory.txt")
    steps = np.linalg.norm(np.diff(trajectory[:, 1:4], axis=0), axis=1)
    assert steps.max() < 5 * np.median(steps)
    n_posed = len(trajectory) + sum(len(np.loadtxt(path)) for path in (out / "submaps").glob("*.txt"))
    assert n_posed >= 150
