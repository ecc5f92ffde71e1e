"""A run without a fault is good; what is missing makes it usable, and what must be wrong doubtful."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.atlas.atlas import Link, LinkKind
from dualslam.core.events import EventKind
from dualslam.core.types import FloatArray, Frame, Keyframe
from dualslam.map.submap import Submap
from dualslam.run.claims import claims_in_atlas
from dualslam.run.judgement import judge_run
from dualslam.run.results import frame_rows, trajectories_of
from dualslam.system.audit.photometric import MIN_SAMPLES, Sample
from dualslam.system.audit.verdict import Level, ReasonCode, Verdict
from tests.cli.fakes import NO_FEATURES, FakeSystem
from tests.run.test_claims import run as run_in_world
from tests.run.test_claims import without_ties

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


def test_a_zoom_makes_a_run_usable_from_where_it_is_seen() -> None:
    system = run(ahead())
    system.events.add(EventKind.FOCAL_CHANGED, 120, 4.0, None, log_change=-0.1, sigma=0.02)
    verdict = judged(system)
    assert verdict.level is Level.USABLE
    (reason,) = verdict.reasons
    assert (reason.code, reason.first_frame, reason.last_frame) == (ReasonCode.ZOOM, 120, N - 1)
    assert "10 % shorter" in reason.text


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
    verdict = judged(system)
    assert (verdict.level, verdict.doubt_about(190)) == (Level.GOOD, "")
    (remark,) = verdict.reasons
    assert (remark.code, remark.first_frame, remark.last_frame) == (ReasonCode.UNPOSED, 180, N - 1)


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


def test_no_pose_is_doubtful() -> None:
    verdict = judged(run(ahead(), lost=tuple(range(N))))
    assert (verdict.level, verdict.reasons[0].code) == (Level.DOUBTFUL, ReasonCode.NO_MAP)
    assert (verdict.reasons[0].first_frame, verdict.reasons[0].last_frame) == (0, N - 1)


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


@pytest.mark.parametrize(("bend", "level"), [(1.0, Level.GOOD), (1.3, Level.USABLE)])
def test_a_map_that_contradicts_the_one_it_was_replaced_by_makes_a_run_usable(bend: float, level: Level) -> None:
    truth = ahead()
    for i, T in truth.items():
        T[:2, 3] = 2.0 * np.sin(i / 40), np.cos(i / 40)
    system = run(truth)
    earlier = Submap(1, np.eye(3), np.zeros(32, np.uint8))
    for i in range(20, 120, 5):
        T = truth[i].copy()
        T[:3, 3] *= 0.4 * (bend if i > 70 else 1.0)
        earlier.add_keyframe(Keyframe(i, i / 30, NO_FEATURES), T)
    system.atlas.add(earlier)
    verdict = judged(system)
    assert verdict.level is level
    about = [(reason.code, reason.first_frame, reason.last_frame) for reason in verdict.reasons]
    assert about == [(ReasonCode.REPLACED, 20, 115)] * (level is Level.USABLE)


def test_a_map_that_does_not_know_its_own_scale_contradicts_nothing() -> None:
    system, _ = run_in_world.__wrapped__()
    main = system.atlas.submaps[0]
    ids = sorted(main.keyframes)
    border = ids[len(ids) // 2]
    earlier = without_ties(main, border)
    earlier.id = 1
    seen_late = np.unique(earlier.observations["landmark"][earlier.observations["kf"] >= border])
    centre = earlier.T_submap_kf[border][:3, 3].copy()
    for k in ids:
        if k >= border:
            earlier.T_submap_kf[k][:3, 3] += 0.5 * (earlier.T_submap_kf[k][:3, 3] - centre)
    earlier.landmarks["xyz_mu"][seen_late] += 0.5 * (earlier.landmarks["xyz_mu"][seen_late] - centre)
    system.atlas.add(earlier)
    trajectories, claims = trajectories_of(system), claims_in_atlas(system.atlas)
    verdict = judge_run(system, trajectories, frame_rows(system, claims=claims), claims=claims)
    assert verdict.level is Level.GOOD
    assert judge_run(system, trajectories, frame_rows(system)) == verdict


def test_a_camera_that_hung_has_not_jumped() -> None:
    truth = ahead()
    for i in range(80, 110):
        truth[i] = truth[80]
    system = run(truth)
    assert judged(system).level is Level.DOUBTFUL
    system.audit.repeated.update(range(81, 110))
    assert judged(system).level is Level.GOOD


@pytest.mark.parametrize(
    ("sigma", "n_frames", "level"),
    [(np.inf, 24, "usable"), (0.13, 24, "usable"), (0.13, 16, "good"), (0.08, 24, "good")],
)
def test_where_the_scale_of_more_than_a_tenth_of_the_frames_is_unsure_a_run_is_usable(
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
    assert about == [(ReasonCode.SCALE, 80, 103)] * (level == "usable")


def test_frames_of_a_strided_run_are_neighbours() -> None:
    system = run(ahead())
    rows = [
        replace(row, index=2 * row.index, sigma_scale=0.2 if 80 <= row.index < 120 and row.index != 90 else 0.02)
        for row in frame_rows(system)  # type: ignore[arg-type]
    ]
    (reason,) = judge_run(system, trajectories_of(system), rows).reasons  # type: ignore[arg-type]
    assert (reason.code, reason.first_frame, reason.last_frame) == (ReasonCode.SCALE, 182, 238)


@pytest.mark.parametrize(
    ("is_sure", "lost", "level"), [(True, 60, Level.GOOD), (False, 60, Level.USABLE), (False, 12, Level.GOOD)]
)
def test_a_join_of_unsure_scale_makes_the_smaller_part_doubtful(is_sure: bool, lost: int, level: Level) -> None:
    """Unless it is a tenth of the frames or less."""
    system = run(ahead(), lost=(lost,))
    old, new = sorted(system.atlas.submaps)
    unsure = Link(old, new, np.eye(4), 1e-3 * np.eye(7), LinkKind.RECOVERY, (), 0, lost + 1, is_sure=is_sure)
    system.atlas.link(unsure)
    verdict = judged(system)
    assert verdict.level is level
    assert verdict.doubt_about(lost - 1) == ("" if level is Level.GOOD else "scale")
    assert verdict.doubt_about(100) == ""
    # A loop that knows its scale joins the same two.
    system.atlas.link(Link(old, new, np.eye(4), 1e-8 * np.eye(7), LinkKind.LOOP, keyframe_a=0, keyframe_b=lost + 1))
    assert judged(system) == Verdict(Level.GOOD)
