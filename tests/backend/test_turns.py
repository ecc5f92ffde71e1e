"""The camera's turns by a gyroscope or an odometry while a run goes on: what is known of them, and when nothing is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.backend.measurements.kinds import RelativePose
from dualslam.backend.measurements.registry import readings_of
from dualslam.backend.measurements.turns import MIN_FRAMES, TurnPrior
from dualslam.core.geometry import se3, so3
from dualslam.core.trajectory import Trajectory
from dualslam.core.types import FailureReason
from dualslam.lab.simulated_measurements import Gyroscope

RATE_HZ, N_SEEN, GAP = 10.0, 150, slice(150, 170)
BIAS = (0.01, -0.02, 0.005)


def hand(seed: int = 0) -> Trajectory:
    """A camera in a hand: it turns about all axes."""
    t = np.arange(220) / RATE_HZ
    rng = np.random.default_rng(seed)
    phase, speed = rng.uniform(0, 6, 3), rng.uniform(0.7, 1.3, 3)
    R = so3.exp(np.stack([0.5 * np.sin(s * t + p) for s, p in zip(speed, phase, strict=True)], 1))
    return Trajectory(t, se3.from_parts(R, np.zeros((len(t), 3))))


def prior_of(truth: Trajectory, clock_off_s: float = 0.0, seen: Trajectory | None = None, n: int = N_SEEN) -> TurnPrior:
    """A phone's gyroscope along a path, turned against the camera, fitted to noisy frames."""
    source = Gyroscope(bias_rad_s=BIAS, turn_rad=(0.3, 1.0, 0.2), seed=1).rates(truth)
    rows = [replace(row, values=(row.values[0] - clock_off_s, *row.values[1:])) for row in source.rows]
    prior = TurnPrior(readings_of(replace(source, rows=rows)).readings)
    show(prior, truth if seen is None else seen, n)
    return prior


def show(prior: TurnPrior, seen: Trajectory, n: int) -> None:
    rng = np.random.default_rng(2)
    for t, T in zip(seen.timestamps_s[:n].tolist(), seen.T_world_cam[:n], strict=True):
        prior.note(t, T[:3, :3] @ so3.exp(rng.normal(0, 1e-3, 3)), 0)


def true_turn(truth: Trajectory) -> np.ndarray:
    return truth.T_world_cam[GAP.start, :3, :3].T @ truth.T_world_cam[GAP.stop, :3, :3]


@pytest.mark.parametrize("clock_off_s", [0.0, 0.7])
def test_a_gyroscope_of_unknown_mount_bias_and_clock_knows_the_turn_through_a_gap(clock_off_s):
    truth = hand()
    prior = prior_of(truth, clock_off_s)
    times = truth.timestamps_s[[GAP.start, GAP.stop]].tolist()
    turn = prior.turn(*times)
    off = so3.rotation_angle(turn.R_a_b.T @ true_turn(truth))
    assert turn.sigma_rad < np.radians(1.0)
    assert off < 3 * turn.sigma_rad
    assert so3.rotation_angle(true_turn(truth)) > np.radians(20)
    back = prior.known.turn(*times[::-1])
    np.testing.assert_allclose(back.R_a_b, turn.R_a_b.T)


def test_an_odometry_knows_it_too():
    truth = hand()
    T, t = truth.T_world_cam, truth.timestamps_s.tolist()
    prior = TurnPrior([RelativePose(t[i], t[i + 2], se3.inverse(T[i]) @ T[i + 2], 0.1, 1e-3) for i in range(0, 218, 2)])
    show(prior, truth, N_SEEN)
    turn = prior.turn(t[GAP.start], t[GAP.stop])
    assert so3.rotation_angle(turn.R_a_b.T @ true_turn(truth)) < 3 * turn.sigma_rad


def test_nothing_is_known_before_frames_confirm_it_or_beyond_the_readings():
    truth = hand()
    assert prior_of(truth, n=MIN_FRAMES).known is None
    known = prior_of(truth).known
    assert known.turn(21.0, 23.0) is None


def test_a_gyroscope_of_another_recording_is_not_believed():
    assert prior_of(hand(), seen=hand(5)).known is None


def test_readings_may_come_with_the_frames():
    truth = hand()
    readings = readings_of(Gyroscope(bias_rad_s=BIAS, seed=1).rates(truth)).readings
    prior = TurnPrior()
    rest = iter(readings)
    for i, (t, T) in enumerate(zip(truth.timestamps_s.tolist(), truth.T_world_cam, strict=True)):
        prior.add([next(rest) for _ in range(10) if i < N_SEEN + 40])
        if i < N_SEEN:
            prior.note(t, T[:3, :3], 0)
    prior.note(truth.timestamps_s[GAP.stop], truth.T_world_cam[GAP.stop, :3, :3], 1)
    turn = prior.turn(*truth.timestamps_s[[GAP.start, GAP.stop]].tolist())
    assert turn is not None
    assert so3.rotation_angle(turn.R_a_b.T @ true_turn(truth)) < 3 * turn.sigma_rad


def test_a_rotation_beyond_its_sigmas_is_refused():
    truth = hand()
    turn = prior_of(truth).turn(*truth.timestamps_s[[GAP.start, GAP.stop]].tolist())
    R = true_turn(truth)
    assert turn.refuse(R, np.zeros((6, 6))) is None
    wrong = R @ so3.exp([0.0, np.radians(4.0), 0.0])
    assert turn.refuse(wrong, np.zeros((6, 6))).reason is FailureReason.LEAP
    loose = np.eye(6) * np.radians(2.0) ** 2
    assert turn.refuse(wrong, loose) is None


def test_a_predicted_pose_takes_the_rotation_and_keeps_the_place():
    truth = hand()
    turn = prior_of(truth).turn(*truth.timestamps_s[[GAP.start, GAP.stop]].tolist())
    of_map = turn.after(truth.T_world_cam[GAP.start, :3, :3])
    predicted = se3.inverse(se3.from_parts(np.eye(3), [1.0, 2.0, 3.0]))
    T_map_cam = se3.inverse(of_map.of(predicted))
    np.testing.assert_allclose(T_map_cam[:3, 3], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(T_map_cam[:3, :3], truth.T_world_cam[GAP.start, :3, :3] @ turn.R_a_b)
