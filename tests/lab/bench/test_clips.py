"""Clips about a loss: written, read back, and scored by trajectories of known faults."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dualslam.core.errors import InputError
from dualslam.io.trajectory_files import Trajectory, read_tum, write_tum
from dualslam.lab.audits.join_audit import JoinOutcome
from dualslam.lab.bench.clips import score_clip, write_clip
from dualslam.lab.bench.plan import Trial, plan_trials
from dualslam.lab.bench.spec import BenchSpec
from dualslam.run.bench_trial import describe_source
from dualslam.run.sources import open_source

SPEC = BenchSpec.model_validate_json("""{
  "name": "clips",
  "sequences": [{"name": "s", "source": "synthetic:street,frames=32,seed={seed},width=64,height=48", "frames": 30}],
  "variants": [{"name": "Dual"}],
  "conditions": [{"name": "gap", "corruptions": [{"kind": "drop", "frames": 4, "at": [0.4, 0.4]}]}],
  "trials": 1
}""")


@pytest.fixture(scope="module")
def trial() -> Trial:
    (trial,) = plan_trials(SPEC, lambda sequence: describe_source(sequence, None))
    return trial


@pytest.fixture(scope="module")
def clip(trial: Trial, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("clip")
    write_clip(trial, open_source(trial.source, start=trial.start, max_frames=trial.max_frames), out)  # type: ignore[arg-type]
    return out


def test_a_clip_is_a_sequence_that_can_be_opened(clip: Path, trial: Trial) -> None:
    opened = open_source(clip)
    assert len(opened) == trial.max_frames - 4
    true = open_source(trial.source)
    assert pytest.approx(true.camera.K) == opened.camera.K
    frame = next(iter(opened))
    expected = next(iter(open_source(trial.source, start=trial.start)))
    assert np.array_equal(frame.image, expected.image)
    assert frame.timestamp_s == pytest.approx(expected.timestamp_s)


@pytest.mark.parametrize(
    ("shift_m", "kept", "outcome"),
    [
        (0.0, slice(None), JoinOutcome.RIGHT),
        (3.0, slice(None), JoinOutcome.WRONG),
        (0.0, slice(14, None), JoinOutcome.NOT_JOINED),
        (0.0, slice(0, 0), JoinOutcome.NOT_JOINED),
    ],
)
def test_a_trajectory_is_judged(clip: Path, tmp_path: Path, shift_m: float, kept: slice, outcome: JoinOutcome) -> None:
    truth = read_tum(clip / "groundtruth_tum.txt")
    T = truth.T_world_cam.copy()
    T[11:, 0, 3] += shift_m
    T[:, :3, 3] *= 0.2
    write_tum(tmp_path / "trajectory.txt", Trajectory(truth.timestamps_s[kept], T[kept]))
    assert score_clip(clip, tmp_path / "trajectory.txt").outcome is outcome


def test_what_is_no_clip_is_refused(trial: Trial, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has no clip\.json"):
        score_clip(tmp_path, tmp_path / "trajectory.txt")
    undisturbed = replace(trial, config=trial.config | {"corruptions": []})
    with pytest.raises(InputError, match="no passing disturbance"):
        write_clip(undisturbed, open_source(trial.source), tmp_path)  # type: ignore[arg-type]
