"""The numbers of the evaluation: against a case done by hand, against evo, and against an independent scorer."""

from __future__ import annotations

import copy
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PoseTrajectory3D

from dualslam.core.errors import InputError
from dualslam.core.geometry import so3
from dualslam.io import Trajectory, write_tum
from dualslam.io.run_folder import FRAME_COLUMNS
from dualslam.io.trajectory_files import read_tum
from dualslam.lab.metrics.alignment import align_points
from dualslam.lab.metrics.trajectory_metrics import evaluate_run, score_trajectory


@dataclass(frozen=True)
class KnownSequence:
    name: str
    frame_timestamps: np.ndarray
    ground_truth: Trajectory | None


def poses(positions: np.ndarray, rotations: np.ndarray | None = None) -> np.ndarray:
    T = np.tile(np.eye(4), (len(positions), 1, 1))
    T[:, :3, 3] = positions
    if rotations is not None:
        T[:, :3, :3] = rotations
    return T


def curve(n: int = 120, rate_hz: float = 10.0) -> Trajectory:
    t = np.arange(n) / rate_hz
    positions = np.stack([3 * np.sin(0.5 * t), 0.3 * np.cos(1.1 * t), 2 * t], 1)
    rotations = so3.exp(np.stack([0.1 * np.sin(t), 0.5 * np.sin(0.5 * t), 0.05 * t], 1))
    return Trajectory(t, poses(positions, rotations))


def estimate_of(truth: Trajectory, seed: int = 0, drift: float = 0.2) -> Trajectory:
    """The truth seen in another world and unit, with noise, and a scale that drifts."""
    rng = np.random.default_rng(seed)
    n = len(truth)
    R = so3.exp(np.array([0.4, -1.0, 2.0]))
    p = truth.T_world_cam[:, :3, 3] * np.linspace(1, 1 + drift, n)[:, None] + rng.normal(0, 0.02, (n, 3))
    noise = so3.exp(rng.normal(0, 0.01, (n, 3)))
    return Trajectory(
        truth.timestamps_s + rng.uniform(-0.004, 0.004, n),
        poses(0.37 * p @ R.T + [5, 6, 7], R @ truth.T_world_cam[:, :3, :3] @ noise),
    )


# --- by hand


def test_a_case_done_by_hand() -> None:
    # The true camera moves 1 m a second along x on a square wave in y, the estimate halves everything and is 0.25
    # (0.5 m) off in z, up and down in turn: no similarity can take that away.
    n = 40
    t = np.arange(n) * 0.5
    x = 0.5 * np.arange(n)
    y = np.where((np.arange(n) // 2) % 2, 1.0, -1.0)
    z = np.where(np.arange(n) % 2, 0.5, -0.5)
    truth = Trajectory(t, poses(np.stack([x, y, 0 * x], 1)))
    estimate = Trajectory(t, poses(0.5 * np.stack([x, y, z], 1)))
    frame_times = np.arange(50) * 0.5
    score = score_trajectory(estimate, truth, frame_times)
    assert (score.frames, score.posed, score.off_clock, score.compared) == (50, 40, 0, 40)
    assert score.coverage_pct == 80.0
    assert score.ate_rmse_m == pytest.approx(0.5, abs=5e-3)
    assert score.scale == pytest.approx(2.0, rel=0.01)
    assert score.path_m == pytest.approx(20 * 0.5 + 19 * np.hypot(0.5, 2.0))
    assert score.ate_pct_of_path == pytest.approx(100 * score.ate_rmse_m / score.path_m)
    assert score.spread_m == pytest.approx(np.sqrt(x.var() + 1.0))
    # Two frames on, z is where it was and y has crossed: 0.5 m/s x 1 s and 2 m, known but for the alignment's scale.
    assert score.rpe_1s_rot_deg_median == 0.0
    assert score.rpe_1s_trans_pct_median == pytest.approx(100 * abs(score.scale / 2 - 1), rel=1e-6)


def test_a_similarity_costs_nothing() -> None:
    truth = curve()
    R, s, t = so3.exp(np.array([0.3, 2.0, -1.0])), 0.2, np.array([1.0, 2.0, 3.0])
    T = poses(s * truth.T_world_cam[:, :3, 3] @ R.T + t, R @ truth.T_world_cam[:, :3, :3])
    score = score_trajectory(Trajectory(truth.timestamps_s, T), truth, truth.timestamps_s)
    assert score.ate_rmse_m == pytest.approx(0, abs=1e-12)
    assert score.scale == pytest.approx(1 / s)
    assert score.scale_drift == pytest.approx(1)
    assert score.rpe_1s_trans_pct_median == pytest.approx(0, abs=1e-9)
    assert score.rpe_1s_rot_deg_median == pytest.approx(0, abs=1e-5)
    rigid = score_trajectory(Trajectory(truth.timestamps_s, T), truth, truth.timestamps_s, alignment="se3")
    assert rigid.scale == 1.0
    assert rigid.ate_rmse_m > 1


def test_rotation_error_over_one_second() -> None:
    truth = curve()
    slow = so3.exp(np.radians(2.0) * truth.timestamps_s[:, None] * [0.0, 1.0, 0.0])
    T = poses(truth.T_world_cam[:, :3, 3], slow)
    still = Trajectory(truth.timestamps_s, poses(truth.T_world_cam[:, :3, 3]))
    score = score_trajectory(Trajectory(truth.timestamps_s, T), still, truth.timestamps_s)
    assert score.rpe_1s_rot_deg_median == pytest.approx(2.0, rel=1e-6)


def test_where_the_true_camera_stands_still_rounding_is_no_motion() -> None:
    truth, rng = curve(), np.random.default_rng(0)
    still = Trajectory(truth.timestamps_s, poses(np.full((120, 3), [10.1, -20.3, 1e3]), truth.T_world_cam[:, :3, :3]))
    moving = Trajectory(truth.timestamps_s, poses(rng.normal(size=(120, 3)), truth.T_world_cam[:, :3, :3]))
    score = score_trajectory(moving, still, truth.timestamps_s)
    assert score.rpe_1s_rot_deg_median == pytest.approx(0, abs=1e-5)
    assert score.rpe_1s_trans_pct_median is None


# --- completeness


def test_too_few_poses_are_counted_but_not_scored() -> None:
    truth = curve()
    few = Trajectory(truth.timestamps_s[:9], truth.T_world_cam[:9])
    score = score_trajectory(few, truth, truth.timestamps_s)
    assert (score.posed, score.compared, score.ate_rmse_m) == (9, 9, None)
    assert "ate_rmse_m" not in score.as_dict()
    none = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    assert score_trajectory(none, truth, truth.timestamps_s).coverage_pct == 0.0


def test_poses_of_no_frame_and_frames_without_truth() -> None:
    truth = curve()
    times = truth.timestamps_s.copy()
    estimate = Trajectory(np.append(times, 500.0), np.concatenate([truth.T_world_cam, np.eye(4)[None]]))
    half = Trajectory(times[:60], truth.T_world_cam[:60])
    score = score_trajectory(estimate, half, times)
    assert (score.off_clock, score.posed, score.compared) == (1, 120, 60)
    assert score_trajectory(estimate, half, times[::-1]) == score, "frames may have been read backwards"


def test_different_clocks_are_refused() -> None:
    truth = curve()
    with pytest.raises(InputError, match="different clocks"):
        score_trajectory(truth, truth, truth.timestamps_s + 1.4e9)
    with pytest.raises(InputError, match="the time of the one before"):
        score_trajectory(truth, truth, np.repeat(truth.timestamps_s[::4], 4))
    with pytest.raises(InputError, match="two frames"):
        score_trajectory(truth, truth, truth.timestamps_s[:1])


def test_a_straight_line_and_a_still_camera_are_scored_too() -> None:
    n = 50
    t = np.arange(n) * 0.1
    line = Trajectory(t, poses(np.stack([0 * t, 0 * t, t], 1)))
    assert score_trajectory(line, line, t).ate_rmse_m == pytest.approx(0, abs=1e-12)
    still = Trajectory(t, np.tile(np.eye(4), (n, 1, 1)))
    score = score_trajectory(still, line, t)
    assert score.ate_rmse_m == pytest.approx(score.spread_m)
    assert score_trajectory(still, still, t).rpe_1s_trans_pct_median is None


# --- against evo


@pytest.mark.parametrize("alignment", ["sim3", "se3"])
def test_against_evo(alignment: str) -> None:
    truth = curve()
    estimate = Trajectory(truth.timestamps_s, estimate_of(truth).T_world_cam)
    score = score_trajectory(estimate, truth, truth.timestamps_s, alignment=alignment)  # type: ignore[arg-type]

    reference = PoseTrajectory3D(poses_se3=list(truth.T_world_cam), timestamps=truth.timestamps_s)
    aligned = copy.deepcopy(PoseTrajectory3D(poses_se3=list(estimate.T_world_cam), timestamps=estimate.timestamps_s))
    _, _, s = aligned.align(reference, correct_scale=alignment == "sim3")
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, aligned))
    assert score.ate_rmse_m == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), rel=1e-9)
    assert score.ate_max_m == pytest.approx(ape.get_statistic(metrics.StatisticsType.max), rel=1e-9)
    assert score.scale == pytest.approx(s, rel=1e-9)
    assert score.path_m == pytest.approx(reference.path_length, rel=1e-12)

    # At 10 Hz without gaps, one second is ten frames.
    rpe = metrics.RPE(metrics.PoseRelation.rotation_angle_deg, delta=10, delta_unit=metrics.Unit.frames, all_pairs=True)
    rpe.process_data((reference, aligned))
    # Ours has one pair more, as an independent scorer: a pair may be one frame short of a second.
    median = rpe.get_statistic(metrics.StatisticsType.median)
    assert score.rpe_1s_rot_deg_median == pytest.approx(median, rel=0.02)


def test_alignment_against_numerical_search() -> None:
    rng = np.random.default_rng(1)
    p, q = rng.normal(size=(30, 3)), rng.normal(size=(30, 3))
    s, R, t = align_points(p, q)
    best = ((q - (s * p @ R.T + t)) ** 2).sum()
    assert np.linalg.det(R) == pytest.approx(1)
    for _ in range(200):
        R_near = R @ so3.exp(rng.normal(0, 1e-3, 3))
        other = ((q - (s * (1 + rng.normal(0, 1e-3)) * p @ R_near.T + t + rng.normal(0, 1e-3, 3))) ** 2).sum()
        assert other >= best


# --- run folders


@pytest.fixture
def run(tmp_path: Path) -> tuple[Path, KnownSequence]:
    truth = curve()
    estimate = estimate_of(truth)
    write_tum(tmp_path / "run" / "trajectory.txt", Trajectory(estimate.timestamps_s[:70], estimate.T_world_cam[:70]))
    write_tum(
        tmp_path / "run" / "submaps" / "02.txt", Trajectory(estimate.timestamps_s[80:], estimate.T_world_cam[80:])
    )
    return tmp_path / "run", KnownSequence("curve", truth.timestamps_s, truth)


def test_evaluate_run_with_an_unlinked_submap(run: tuple[Path, KnownSequence]) -> None:
    folder, sequence = run
    result = evaluate_run(folder, sequence)
    assert (result["frames"], result["posed"]) == (120, 70)
    (submap,) = result["submaps"]
    assert (submap["submap"], submap["posed"]) == (2, 40)
    assert submap["scale"] != pytest.approx(result["scale"], rel=1e-3), "each has its own alignment"
    json.dumps(result)


def test_keyframes_are_scored_by_themselves_too(run: tuple[Path, KnownSequence]) -> None:
    folder, sequence = run
    chosen = read_tum(folder / "trajectory.txt").timestamps_s[::5]
    result = evaluate_run(folder, sequence, keyframe_times_s=chosen)
    assert result["keyframes"]["posed"] == len(chosen)
    assert {name: value for name, value in result.items() if name != "keyframes"} == evaluate_run(folder, sequence)


def test_a_run_of_another_sequence_is_refused_by_its_times(run: tuple[Path, KnownSequence]) -> None:
    folder, sequence = run
    (folder / "summary.json").write_text('{"sequence": "curve"}')
    for shift_s, refused in ((0.0, False), (0.0004, False), (0.013, True)):
        rows = [
            f"{i},{t + shift_s!r},tracked,0,1,90,80,5.0,," for i, t in enumerate(sequence.frame_timestamps.tolist())
        ]
        (folder / "frames.csv").write_text("\n".join([",".join(FRAME_COLUMNS[:10]), *rows, ""]))
        if refused:
            with pytest.raises(InputError, match=r"frames at other times; .*trajectory\.txt"):
                evaluate_run(folder, sequence)
        else:
            evaluate_run(folder, sequence)


def test_a_run_of_a_sequence_with_another_name_is_told(
    run: tuple[Path, KnownSequence], caplog: pytest.LogCaptureFixture
) -> None:
    folder, sequence = run
    (folder / "summary.json").write_text('{"sequence": "curve"}')
    evaluate_run(folder, sequence)
    assert not caplog.records
    (folder / "summary.json").write_text('{"sequence": "kitti_03"}')
    evaluate_run(folder, sequence)
    assert [r.getMessage() for r in caplog.records] == [f"{folder} was made of kitti_03, and is scored against curve"]


def test_evaluate_run_that_posed_nothing(tmp_path: Path) -> None:
    truth = curve()
    (tmp_path / "trajectory.txt").write_text("")
    result = evaluate_run(tmp_path, KnownSequence("curve", truth.timestamps_s, truth))
    assert result["coverage_pct"] == 0.0
    assert result["submaps"] == []


def test_evaluate_run_needs_its_inputs(tmp_path: Path) -> None:
    truth = curve()
    with pytest.raises(InputError, match="curve has no ground truth"):
        evaluate_run(tmp_path, KnownSequence("curve", truth.timestamps_s, None))
    with pytest.raises(InputError, match=r"trajectory\.txt does not exist"):
        evaluate_run(tmp_path, KnownSequence("curve", truth.timestamps_s, truth))
    (tmp_path / "bare.txt").write_text("")
    with pytest.raises(InputError, match=r"bare\.txt is empty"):
        evaluate_run(tmp_path / "bare.txt", KnownSequence("curve", truth.timestamps_s, truth))


@pytest.mark.skipif("DUALSLAM_SCORE" not in os.environ, reason="DUALSLAM_SCORE does not name an independent scorer")
@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_the_agreed_scorer(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = curve(300, rate_hz=20.0)
    estimate = estimate_of(truth, seed, drift=0.3)
    kept = np.sort(rng.choice(300, 200, replace=False))
    estimate = Trajectory(estimate.timestamps_s[kept], estimate.T_world_cam[kept])
    (tmp_path / "times.txt").write_text("".join(f"{t!r}\n" for t in truth.timestamps_s.tolist()))
    write_tum(tmp_path / "groundtruth_tum.txt", truth)
    write_tum(tmp_path / "trajectory.txt", estimate)
    command = [sys.executable, os.environ["DUALSLAM_SCORE"], str(tmp_path), str(tmp_path), "--json"]
    theirs = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    ours = evaluate_run(tmp_path, KnownSequence("curve", truth.timestamps_s, truth))
    assert set(theirs) == set(ours) - {"submaps"}
    for name, value in theirs.items():
        # It prints 2 to 6 decimals: half of the last one comes on top.
        decimals = {"path_m": 3, "rpe_1s_trans_pct_median": 3, "scale": 6}
        decimals |= dict.fromkeys(("coverage_pct", "broken_pct", "first_broken_s"), 2)
        assert ours[name] == pytest.approx(value, rel=1e-4, abs=0.5 * 10.0 ** -decimals.get(name, 4)), name
