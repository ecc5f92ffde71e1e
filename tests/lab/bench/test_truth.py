"""What the truth says of trajectories that were made with known faults."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dualslam.core.config.corruption import Corruption
from dualslam.core.geometry import so3
from dualslam.io.trajectory_files import Trajectory, write_tum
from dualslam.lab.bench.measure import trajectory_error
from dualslam.lab.bench.record import Breakage, JoinCause
from dualslam.lab.bench.truth import TrueFrames, are_untrue, compare, read_verdict, true_frames

N, RATE_HZ = 240, 20.0
INDEX = 100 + 2 * np.arange(N)
TIMES_S = 50.0 + np.arange(N) / RATE_HZ


def truth() -> Trajectory:
    T = np.tile(np.eye(4), (N, 1, 1))
    a = np.arange(N) / 40
    T[:, :3, 3] = np.stack([5 * np.cos(a), 6 * np.sin(a), 0.3 * a], 1)
    T[:, :3, :3] = np.array([so3.exp(np.array([0.0, 0.0, x])) for x in a])
    return Trajectory(TIMES_S, T)


def frames(*corruptions: dict[str, Any]) -> TrueFrames:
    return true_frames(INDEX, TIMES_S, truth(), [Corruption.model_validate(c) for c in corruptions])


def estimate(kept: np.ndarray | None = None) -> Trajectory:
    """The truth in another unit, with times of a wrong clock."""
    T = truth().T_world_cam.copy()
    T[:, :3, 3] *= 0.3
    kept = np.arange(N) if kept is None else kept
    return Trajectory(1000.0 * TIMES_S[kept], T[kept], INDEX[kept])


def compared(main: Trajectory, known: TrueFrames | None = None, submap: np.ndarray | None = None, **more: Any) -> Any:
    submap = np.zeros(len(main), np.int64) if submap is None else submap
    return compare(known or frames(), main, submap, more.pop("initialised_at", 0), **more)


def test_a_right_run_has_no_fault_whatever_its_clock_and_unit() -> None:
    found = compared(estimate())
    assert (found["n_clear"], found["n_clear_posed"]) == (N, N)
    assert (found["broken"], found["excepted"], found["joins"]) == (0, 0, ())
    assert found["judged"] > 15


def test_frames_under_a_passing_disturbance_cannot_be_posed_and_those_before_a_start_do_not_count() -> None:
    known = frames({"kind": "blackout", "start": 200, "length": 40}, {"kind": "noise", "strength": 5})
    found = compared(estimate(np.arange(10, N - 30)), known, initialised_at=10)
    assert (found["n_clear"], found["n_clear_posed"]) == (N - 10 - 20, N - 10 - 20 - 30)


def test_frames_that_do_not_arrive_are_not_missed() -> None:
    known = frames({"kind": "drop", "start": 200, "length": 40})
    assert len(known.index) == N - 20
    main = estimate(np.flatnonzero(np.isin(INDEX, known.index)))
    assert compared(main, known)["n_clear_posed"] == N - 20


def test_a_frozen_camera_shows_an_older_pose() -> None:
    known = frames({"kind": "freeze", "start": 200, "length": 40})
    shown = truth().T_world_cam
    assert np.array_equal(known.T_world_cam[50:70], np.repeat(shown[49:50], 20, axis=0))
    assert np.array_equal(known.T_world_cam[70], shown[70])
    assert not known.is_still
    assert frames({"kind": "freeze"}).is_still


def test_a_false_step_between_submaps_is_a_false_join_and_breaks_stretches() -> None:
    main = estimate()
    main.T_world_cam[120:, 0, 3] += 0.5
    submap = np.repeat([0, 1], 120)
    found = compared(main, submap=submap)
    assert [(j.frame, j.outcome, j.cause) for j in found["joins"]] == [(int(INDEX[120]), "wrong", JoinCause.SEAM)]
    assert found["joins"][0].offset_m == pytest.approx(0.5 / 0.3, rel=0.05)
    assert found["broken"] >= 3
    right = compared(estimate(), submap=submap)
    assert [j.outcome for j in right["joins"]] == ["right"]


def test_a_loss_is_joined_or_not() -> None:
    lost = Breakage(int(INDEX[100]), 0, "too_few_matches", restart_frames=40)
    joined = compared(estimate(np.r_[:100, 120:N]), breakages=[lost])["joins"]
    left = compared(estimate(np.arange(120, N)), breakages=[lost])["joins"]
    assert [(j.outcome, j.cause) for j in (*joined, *left)] == [
        ("right", JoinCause.LOSS),
        ("not joined", JoinCause.LOSS),
    ]


def test_a_passing_disturbance_is_joined_or_not_whether_or_not_a_map_was_lost() -> None:
    known = frames({"kind": "drop", "start": 300, "length": 40}, {"kind": "noise"}, {"kind": "stride", "length": 90})
    assert known.disturbed == ((300, 340),)
    main = estimate(np.flatnonzero(np.isin(INDEX, known.index)))
    main.T_world_cam[main.index >= 340, 0, 3] += 0.5
    (join,) = compared(main, known)["joins"]
    assert (join.frame, join.outcome, join.cause) == (300, "wrong", JoinCause.DISTURBANCE)


def test_a_step_of_the_truth_alone_is_no_break() -> None:
    jumping = truth()
    jumping.T_world_cam[120:, 2, 3] += 6.0
    known = true_frames(INDEX, TIMES_S, jumping, [])
    found = compared(estimate(), known)
    assert (found["broken"], found["excepted"]) == (0, 3)
    jumping_map = estimate()
    jumping_map.T_world_cam[120:, 2, 3] += 1.8
    found = compared(jumping_map)
    assert (found["broken"], found["excepted"]) == (3, 0)


def test_what_touches_frames_of_wrong_truth_is_not_held_against_the_run() -> None:
    main = estimate()
    main.T_world_cam[120:, 0, 3] += 0.5
    submap = np.repeat([0, 1], 120)
    near, far = [[int(INDEX[110]), int(INDEX[130])]], [[int(INDEX[5]), int(INDEX[10])]]
    found = compared(main, submap=submap, truth_breaks=near)
    assert (found["broken"], found["joins"]) == (0, ())
    assert found["excepted"] >= 3
    found = compared(main, submap=submap, truth_breaks=far)
    assert (found["broken"], found["excepted"], len(found["joins"])) == (3, 0, 1)


def test_frames_of_wrong_truth_do_not_count_in_the_error() -> None:
    main, known = estimate(), frames().truth
    main.T_world_cam[100:120, 0, 3] += 0.5
    trusted = known.take(~are_untrue(known.index, [[int(INDEX[100]), int(INDEX[119])]]))
    errors = [trajectory_error(frames().on_true_clock(main), each, TIMES_S)[0] for each in (known, trusted)]
    assert errors[0] is not None
    assert errors[0] > 0.1
    assert errors[1] == pytest.approx(0.0, abs=1e-9)


def test_a_verdict_is_read_where_there_is_one() -> None:
    assert read_verdict({"frames": 3}) == {}
    reason = {"code": "steps", "text": "a step", "first_frame": 3, "last_frame": 9}
    found = read_verdict({"verdict": {"level": "doubtful", "reasons": [reason]}})
    assert found["level"] == "doubtful"
    assert (found["reasons"][0].code, found["reasons"][0].last_frame) == ("steps", 9)


@pytest.mark.skipif("DUALSLAM_SCORE" not in os.environ, reason="DUALSLAM_SCORE does not name an independent scorer")
def test_agrees_with_the_agreed_scorer(tmp_path: Path) -> None:
    main = estimate(np.r_[:90, 110:N])
    main.T_world_cam[150:, :3, 3] += [0.3, 0.2, 0.1]
    rng = np.random.default_rng(5)
    main.T_world_cam[:, :3, 3] += 0.003 * rng.standard_normal((len(main), 3))
    found = compared(main)
    on_true_clock = frames().on_true_clock(main)
    ate_m, path_m = trajectory_error(on_true_clock, truth(), TIMES_S)
    (tmp_path / "times.txt").write_text("".join(f"{t!r}\n" for t in TIMES_S.tolist()))
    write_tum(tmp_path / "groundtruth_tum.txt", truth())
    write_tum(tmp_path / "trajectory.txt", on_true_clock)
    command = [sys.executable, os.environ["DUALSLAM_SCORE"], str(tmp_path), str(tmp_path), "--json"]
    theirs = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert (found["judged"], found["broken"]) == (theirs["judged"], theirs["broken"])
    assert found["broken"] > 0
    assert found["first_broken_s"] == pytest.approx(theirs["first_broken_s"], abs=0.006)
    assert (ate_m, path_m) == pytest.approx((theirs["ate_rmse_m"], theirs["path_m"]), rel=1e-3)
    assert found["n_clear_posed"] == theirs["posed"]
