"""A run without a fault is good; what is missing makes it usable, and what must be wrong doubtful."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.atlas.atlas import Link, LinkKind
from dualslam.core.events import EventKind
from dualslam.core.types import FloatArray, Frame
from dualslam.run.judgement import judge_run
from dualslam.run.results import frame_rows, trajectories_of
from dualslam.system.audit.photometric import MIN_SAMPLES, Sample
from dualslam.system.audit.verdict import Level, ReasonCode, Verdict
from tests.cli.fakes import FakeSystem

N = 200
IMAGE = np.zeros((4, 4), np.uint8)


def ahead(speed_m_s: float = 1.0) -> dict[int, FloatArray]:
    truth = {i: np.eye(4) for i in range(N)}
    for i, T in truth.items():
        T[0, 3] = speed_m_s * i / 30
    return truth


def run(truth: dict[int, FloatArray], lost: tuple[int, ...] = (), interval_s: float = 1 / 30) -> FakeSystem:
    system = FakeSystem(truth, lost)
    for i in range(len(truth)):
        system.step(Frame(i, interval_s * i, IMAGE))
    return system


def judged(system: FakeSystem, dropped: int = 0) -> Verdict:
    for i in range(N, N + dropped):
        system.keep(Frame(i, i / 30, IMAGE))
    return judge_run(system, trajectories_of(system), frame_rows(system))  # type: ignore[arg-type]


def test_a_run_that_poses_all_is_good() -> None:
    assert judged(run(ahead())) == Verdict(Level.GOOD)


def test_a_jump_makes_a_run_doubtful_and_names_its_frames() -> None:
    truth = ahead()
    for i in range(120, N):
        truth[i][2, 3] = 1.0
    system = run(truth)
    verdict = judged(system)
    assert verdict.level is Level.DOUBTFUL
    (reason,) = verdict.reasons
    assert (reason.code, reason.first_frame, reason.last_frame) == (ReasonCode.JUMP, 119, 120)
    assert "frames 119 and 120" in reason.text


def test_maps_that_were_not_joined_make_a_run_usable() -> None:
    verdict = judged(run(ahead(), lost=tuple(range(130, 133))))
    assert verdict.level is Level.USABLE
    (reason,) = verdict.reasons
    assert (reason.code, reason.first_frame, reason.last_frame) == (ReasonCode.UNJOINED, 133, N - 1)
    assert f"67 frames from 133 to {N - 1}" in reason.text


def test_frames_without_a_pose_make_a_run_usable_unless_nothing_is_on_them() -> None:
    lost = tuple(range(180, N))
    system = run(ahead(), lost)
    (reason,) = judged(system).reasons
    assert (reason.code, reason.first_frame, reason.last_frame) == (ReasonCode.UNPOSED, 180, N - 1)
    system.blank.update(lost)
    assert judged(system).level is Level.GOOD


def test_dropped_frames_make_a_run_usable() -> None:
    (reason,) = judged(run(ahead()), dropped=40).reasons
    assert (reason.code, reason.level) == (ReasonCode.DROPPED, Level.USABLE)


def test_a_stretch_that_disagrees_with_the_images_makes_a_run_doubtful_while_its_poses_hold() -> None:
    system = run(ahead())
    system.audit.samples += [Sample(60 + 6 * n, 2 + 0.2 * n, 0, 0.02) for n in range(MIN_SAMPLES)]
    verdict = judged(system)
    assert verdict.level is Level.DOUBTFUL
    (reason,) = verdict.reasons
    assert (reason.code, reason.first_frame, reason.last_frame) == (ReasonCode.PHOTOMETRIC, 60, 72)
    for i in range(60, 73):
        del system.poses[i]
    assert judged(system).level is not Level.DOUBTFUL


def test_a_clock_in_another_unit_or_that_repeats_is_told() -> None:
    verdict = judged(run(ahead(), interval_s=33.3))
    assert (verdict.level, verdict.reasons[0].code) == (Level.GOOD, ReasonCode.CLOCK), "a remark: the poses are right"
    assert verdict.doubt_about(5) == ""
    system = run(ahead())
    system.rows[7].timestamp_s = system.rows[6].timestamp_s
    (reason,) = judged(system).reasons
    assert reason.code is ReasonCode.CLOCK
    assert reason.text.startswith(f"1 of {N} timestamps")


def test_a_focal_length_that_is_hardly_known_makes_a_run_usable() -> None:
    system = run(ahead())
    system.log_focal_sigma = 0.06
    (reason,) = judged(system).reasons
    assert (reason.code, reason.level) == (ReasonCode.FOCAL, Level.USABLE)


def test_no_pose_is_doubtful() -> None:
    verdict = judged(run(ahead(), lost=tuple(range(N))))
    assert (verdict.level, verdict.reasons[0].code) == (Level.DOUBTFUL, ReasonCode.NO_MAP)
    assert (verdict.reasons[0].first_frame, verdict.reasons[0].last_frame) == (0, N - 1)


@pytest.mark.parametrize(("log_focal", "level"), [(0.03, Level.GOOD), (0.41, Level.DOUBTFUL), (-0.2, Level.USABLE)])
def test_a_focal_length_far_from_the_one_used_is_told(log_focal: float, level: Level) -> None:
    system = run(ahead())
    estimates = [{"log_focal": -0.6, "log_focal_sigma": 0.2}, {"log_focal": log_focal, "log_focal_sigma": 0.004}]
    for frame, estimate in zip((60, 90), estimates, strict=True):
        far = abs(estimate["log_focal"]) / 0.05
        system.events.add(
            EventKind.CALIBRATION_KEPT, frame, frame / 30, 0, reason="too far", prior_sigmas=far, **estimate
        )
    system.events.add(EventKind.CALIBRATION_KEPT, 120, 4.0, 0, reason="too little turning")
    verdict = judged(system)
    assert verdict.level is level
    assert [reason.code for reason in verdict.reasons] == [ReasonCode.CAMERA] * (level is not Level.GOOD)


@pytest.mark.parametrize(
    ("answers", "level"),
    [
        ([-0.08], Level.GOOD),
        ([-0.2], Level.USABLE),
        ([-0.2, -0.21], Level.USABLE),
        ([-0.08, -0.104], Level.GOOD),  # 7-Scenes, whose calibration is off by as much
        ([-0.104, -0.109], Level.GOOD),  # not known to be more than a tenth
    ],
)
@pytest.mark.parametrize("last", [EventKind.CALIBRATED, EventKind.CALIBRATION_KEPT])
def test_what_was_tracked_before_a_large_correction_was_taken_over_may_be_broken(
    answers: list[float], level: Level, last: EventKind
) -> None:
    """What counts is by how much the camera in use was off, not the one that was given."""
    system = run(ahead())
    for n, log_focal in enumerate(answers):
        told = {"log_focal": log_focal, "log_focal_sigma": 0.004, "prior_sigmas": abs(log_focal) / 0.05}
        kind = last if n == len(answers) - 1 else EventKind.CALIBRATED
        system.events.add(kind, 60 + 20 * n, 2.0 + n, 0, **told)
    assert judged(system).level is level


def test_another_lens_than_the_one_used_makes_a_run_doubtful() -> None:
    system = run(ahead())
    estimate = {"log_focal": 0.03, "log_focal_sigma": 0.007, "k1": -0.27, "k1_sigma": 0.002, "prior_sigmas": 9.0}
    system.events.add(EventKind.CALIBRATION_KEPT, 60, 2.0, 0, reason="too far", **estimate)
    verdict = judged(system)
    assert (verdict.level, verdict.reasons[0].code) == (Level.DOUBTFUL, ReasonCode.CAMERA)
    assert verdict.scores["camera"] == 9.0


@pytest.mark.parametrize(("stood_since", "level"), [(100, Level.DOUBTFUL), (70, Level.GOOD)])
def test_a_camera_that_moves_in_the_map_alone_makes_a_run_doubtful(stood_since: int, level: Level) -> None:
    """Not where it stands in the map, too: until it was found to stand, and goes on at any time afterwards."""
    truth = ahead()
    for i in range(stood_since, N):
        truth[i][0, 3] = truth[min(stood_since, 100)][0, 3] + max(i - 100, 0) / 30
    system = run(truth)
    system.events.add(EventKind.CAMERA_STANDS, 100, 100 / 30, None)
    system.events.add(EventKind.CAMERA_MOVES, 150, 5.0, None)
    verdict = judged(system)
    assert verdict.level is level
    about = [(reason.code, reason.first_frame, reason.last_frame) for reason in verdict.reasons]
    assert about == [(ReasonCode.STILL, 70, 100)] * (level is Level.DOUBTFUL)


def test_a_camera_that_hung_has_not_jumped() -> None:
    truth = ahead()
    for i in range(80, 110):
        truth[i] = truth[80]
    system = run(truth)
    assert judged(system).level is Level.DOUBTFUL
    system.audit.repeated.update(range(81, 110))
    assert judged(system).level is Level.GOOD


@pytest.mark.parametrize(
    ("sigma", "n_frames", "level"), [(np.inf, 20, "usable"), (0.1, 20, "usable"), (0.1, 8, "good")]
)
def test_where_the_scale_of_more_frames_than_may_be_missing_is_unsure_a_run_is_usable(
    sigma: float, n_frames: int, level: str
) -> None:
    system = run(ahead())
    trajectories = trajectories_of(system)  # type: ignore[arg-type]
    rows = [
        replace(row, sigma_scale=sigma if 80 <= row.index < 80 + n_frames else 0.02)
        for row in frame_rows(system)  # type: ignore[arg-type]
    ]
    verdict = judge_run(system, trajectories, rows)  # type: ignore[arg-type]
    assert verdict.level == Level(level)
    about = [(reason.code, reason.first_frame, reason.last_frame) for reason in verdict.reasons]
    assert about == [(ReasonCode.SCALE, 80, 99)] * (level == "usable")


@pytest.mark.parametrize(("is_sure", "level"), [(True, Level.GOOD), (False, Level.USABLE)])
def test_a_join_of_unsure_scale_makes_the_smaller_part_doubtful(is_sure: bool, level: Level) -> None:
    system = run(ahead(), lost=(60,))
    old, new = sorted(system.atlas.submaps)
    unsure = Link(old, new, np.eye(4), 1e-3 * np.eye(7), LinkKind.RECOVERY, (), 0, 61, is_sure=is_sure)
    system.atlas.link(unsure)
    verdict = judged(system)
    assert verdict.level is level
    assert verdict.doubt_about(59) == ("" if level is Level.GOOD else "scale")
    assert verdict.doubt_about(100) == ""
    # A loop that knows its scale joins the same two.
    system.atlas.link(Link(old, new, np.eye(4), 1e-8 * np.eye(7), LinkKind.LOOP, keyframe_a=0, keyframe_b=61))
    assert judged(system) == Verdict(Level.GOOD)
