"""Early signs before a loss, on tracks made by hand: which frame starts the stretch that may be corrupted."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dualslam.core.config.settings import HealthConfig
from dualslam.core.estimates import GraphEstimate, KeyframeReport
from dualslam.core.geometry import se3
from dualslam.core.types import Failure, FailureReason, Features, Track, View
from dualslam.system.health import HealthMonitor, count_signs
from dualslam.testing.point_world import random_features

CONFIG = HealthConfig()
LOST = Failure(FailureReason.TOO_FEW_MATCHES, "no keyframe matched")
SIGMA = np.array([0.002] * 3 + [0.01] * 3)  # of the motion model, rad and unit
FEATURES: Features = random_features(np.random.default_rng(0), 5)


def track(i: int, innovation: np.ndarray, **changes: Any) -> Track:
    T_predicted = se3.exp(np.array([0, 0.01, 0, 0.1, 0, 0.0]) * i)
    numbers = {"n_matches": 200, "n_inliers": 180, "chi2": 0.8, "wide": False} | changes
    return Track(
        View(i, 0.1 * i, FEATURES),
        se3.exp(innovation) @ T_predicted,
        T_predicted,
        np.zeros(0, np.int64),
        visible_ids=np.zeros(0, np.int64),
        covariance=1e-8 * np.eye(6),
        **numbers,
    )


def watch(n: int, sick: dict[int, dict[str, Any]], lost_from: int | None = None, seed: int = 0) -> HealthMonitor:
    """Judge n frames; `sick`: what is changed in some of them (`jump`: in standard deviations of the motion model)."""
    rng, monitor = np.random.default_rng(seed), HealthMonitor(CONFIG)
    for i in range(n):
        changes = dict(sick.get(i, {}))
        innovation = SIGMA * (rng.normal(size=6) + changes.pop("jump", 0.0))
        judged = LOST if lost_from is not None and i >= lost_from else track(i, innovation, **changes)
        assert bool(monitor.judge(judged, i)) == (judged is not LOST)
    return monitor


def keyframe(chi2: float = 0.5, solver_failed: bool = False) -> KeyframeReport:
    none = np.zeros(0, np.int64)
    estimate = GraphEstimate(none, np.zeros((0, 4, 4)), none, np.zeros((0, 3)), none, chi2, 1.0, solver_failed, 0.0)
    return KeyframeReport(estimate, estimate, solver_failed)


def test_a_sudden_loss_is_suspected_from_its_first_frame_on() -> None:
    suspected = watch(60, {}, lost_from=55).suspected()
    assert [frame.index for frame in suspected] == list(range(55, 60))
    assert all(frame.failed for frame in suspected)


def test_steady_motion_shows_no_signs() -> None:
    """Over 400 frames of Gaussian noise: one in 10,000 is expected beyond the quantile."""
    monitor = watch(400, {})
    assert monitor.suspected() == []
    assert sum(bool(frame.signs) for frame in monitor._frames) <= 1


@pytest.mark.parametrize(
    ("sickness", "reason"),
    [
        ({"jump": 8.0}, FailureReason.MOTION_JUMP),
        ({"n_inliers": 90}, FailureReason.LOW_INLIER_RATIO),
        ({"n_matches": 50, "n_inliers": 45}, FailureReason.TOO_FEW_INLIERS),
        ({"chi2": 1.6}, FailureReason.CHI_SQUARE),
    ],
)
def test_the_onset_is_where_the_signs_begin(sickness: dict[str, Any], reason: FailureReason) -> None:
    """Signs on every third of the last frames; one long before is none of it."""
    sick = dict.fromkeys((20, 44, 47, 50, 53), sickness)
    monitor = watch(60, sick, lost_from=55)
    suspected = monitor.suspected()
    assert suspected[0].index == 44
    assert count_signs(frame for frame in suspected if not frame.failed) == {str(reason): 4}


def test_signs_that_healthy_frames_outweigh_are_forgotten() -> None:
    monitor = watch(60, {40: {"jump": 10.0}, 41: {"jump": -10.0}}, lost_from=55)
    assert monitor.suspected()[0].index == 55
    assert {frame.index for frame in monitor._frames if frame.signs and not frame.failed} >= {40, 41}


def test_a_wilder_motion_is_learnt() -> None:
    """The motion becomes five times as wild: signs at first, none later, though each frame is as far off as before."""
    sick = {i: {"jump": 5.0 * (-1.0) ** i} for i in range(100, 300)}
    monitor = watch(300, sick)
    signs = [bool(frame.signs) for frame in monitor._frames]
    assert np.mean(signs[100:105]) == 1.0
    assert np.mean(signs[250:300]) < 0.1


def test_a_level_of_noise_that_is_always_there_is_no_sign() -> None:
    """The camera model is off, all along: the chi-square is 1.5 from the first frame on."""
    monitor = watch(200, {i: {"chi2": 1.5} for i in range(200)})
    assert not any(frame.signs for frame in list(monitor._frames)[1:])


def test_keyframes_hold_the_graphs_troubles_against_their_frame() -> None:
    monitor = watch(30, {})
    monitor.note_keyframe(keyframe())
    assert monitor.newest is not None
    assert monitor.newest.signs == ()
    monitor.note_keyframe(keyframe(chi2=2.5))
    assert monitor.newest.signs == (FailureReason.CHI_SQUARE,)
    monitor.note_keyframe(keyframe(solver_failed=True))
    assert monitor.newest.signs == (FailureReason.CHI_SQUARE, FailureReason.SOLVER)
    assert [frame.index for frame in monitor.suspected()] == [29]


def test_signs_fail_nothing() -> None:
    monitor = HealthMonitor(CONFIG)
    for i in range(40):
        assert monitor.judge(track(i, np.zeros(6), n_inliers=80, chi2=2.0), i)
    assert monitor.judge(track(40, np.ones(6)), 40)
