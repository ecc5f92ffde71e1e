"""From a run to the line of its trial, and the verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.core.events import Event, EventKind
from dualslam.core.geometry import so3
from dualslam.core.types import FrameStatus
from dualslam.io.run_folder import FrameRow
from dualslam.io.trajectory_files import Trajectory
from dualslam.lab.bench.measure import (
    breakages,
    end_point_error,
    initialisation,
    status_letters,
    trajectory_error,
)
from dualslam.lab.bench.plan import plan_trials
from dualslam.lab.bench.record import (
    Breakage,
    FailureKind,
    LinkError,
    TrialOutcome,
    TrialRecord,
    blank_record,
    judge,
)
from dualslam.lab.bench.spec import Thresholds
from dualslam.testing.point_world import PointWorld, cloud, hand_held, system_in
from tests.lab.bench.fakes import SPEC, describe, run_fake

GOOD = replace(run_fake(plan_trials(SPEC, describe)[0]), status="i" * 4 + "T" * 96, initialised_at=4)


def event(kind: EventKind, frame: int, submap: int | None, **data: object) -> Event:
    return Event(kind, frame, 0.1 * frame, submap, dict(data))


def test_statuses_are_letters_and_capitals_are_in_the_main_map() -> None:
    rows = [
        FrameRow(i, 0.1 * i, status, 0, in_main, 0, 0, 0.0)
        for i, (status, in_main) in enumerate(
            [(FrameStatus.INITIALISING, False), (FrameStatus.TRACKED, True), (FrameStatus.LOST, False)]
            + [(FrameStatus.RECOVERED, True), (FrameStatus.BYPASSED, True), (FrameStatus.TRACKED, False)]
        )
    ]
    assert status_letters(rows) == "iTlRBt"
    events = [event(EventKind.INITIALISATION_REFUSED, 1, None), event(EventKind.INITIALISED, 3, 0)]
    assert initialisation(rows, events) == (3, pytest.approx(0.3))
    assert initialisation(rows, events[:1]) == (None, None)


def test_each_loss_has_its_attempts() -> None:
    events = [
        event(EventKind.INITIALISED, 5, 0),
        event(EventKind.FAILED, 40, 0, reason="too_few_matches"),
        event(EventKind.REINITIALISED, 52, 1),
        event(EventKind.RECOVERY_STARTED, 52, 1, lost=[0]),
        event(EventKind.LINK_REFUSED, 38, 1, old_submap=0, attempt="orb"),
        event(EventKind.RECOVERY_ATTEMPT, 36, 1, attempt="orb"),
        event(EventKind.RECOVERY_ATTEMPT, 36, 1, attempt="sift"),
        event(EventKind.LINKED, 52, 1, old_submap=0, attempt="sift", seconds=1.5),
        event(EventKind.FAILED, 80, 1, reason="motion_jump"),
    ]
    assert breakages(events) == (
        Breakage(40, 0, "too_few_matches", 12, pytest.approx(1.2), 2, 2, 1.5),
        Breakage(80, 1, "motion_jump"),
    )


def test_a_later_recovery_may_link_what_the_first_could_not() -> None:
    events = [
        event(EventKind.FAILED, 40, 0, reason="x"),
        event(EventKind.REINITIALISED, 50, 1),
        event(EventKind.RECOVERY_STARTED, 50, 1, lost=[0]),
        event(EventKind.RECOVERY_ATTEMPT, 36, 1, attempt="orb"),
        event(EventKind.RECOVERY_ATTEMPT, 36, 1, attempt="sift"),
        event(EventKind.FAILED, 60, 1, reason="x"),
        event(EventKind.REINITIALISED, 70, 2),
        event(EventKind.RECOVERY_STARTED, 70, 2, lost=[0, 1]),
        event(EventKind.RECOVERY_ATTEMPT, 36, 2, attempt="orb"),
        event(EventKind.LINKED, 70, 2, old_submap=1, attempt="orb", seconds=1.0),
    ]
    first, second = breakages(events)
    assert (first.attempts, first.succeeded_at) == (2, None)
    assert (second.attempts, second.succeeded_at, second.restart_frames) == (1, 1, 10)


def test_retries_are_no_attempts() -> None:
    events = [
        event(EventKind.FAILED, 40, 0, reason="x"),
        event(EventKind.REINITIALISED, 50, 1),
        event(EventKind.RECOVERY_STARTED, 50, 1, lost=[0], again=False),
        event(EventKind.RECOVERY_ATTEMPT, 36, 1, attempt="gap (sift)"),
        event(EventKind.RECOVERY_ATTEMPT, 36, 1, attempt="live"),
        event(EventKind.RECOVERY_STARTED, 70, 1, lost=[0], again=True),
        event(EventKind.RECOVERY_ATTEMPT, 36, 1, attempt="gap (sift)"),
        event(EventKind.LINKED, 70, 1, old_submap=0, attempt="gap (sift)", seconds=1.0),
    ]
    (lost,) = breakages(events)
    assert (lost.attempts, lost.succeeded_at, lost.retries, lost.linked_by_retry) == (2, None, 1, True)
    assert lost.recovered


def test_a_map_that_a_revisit_joins_is_recovered() -> None:
    events = [event(EventKind.FAILED, 40, 0, reason="x"), event(EventKind.MERGED, 90, 1, other_submap=0)]
    (lost,) = breakages(events)
    assert lost.merged
    assert lost.recovered


def test_a_loss_that_is_never_linked() -> None:
    events = [
        event(EventKind.FAILED, 40, 0, reason="x"),
        event(EventKind.REINITIALISED, 50, 1),
        event(EventKind.RECOVERY_STARTED, 50, 1, lost=[0]),
    ]
    (lost,) = breakages(events)
    assert (lost.attempts, lost.succeeded_at, lost.recovery_s) == (1, None, None)


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({}, None),
        ({"status": "i" * 4 + "T" * 92 + "l" * 4}, None),  # 95.8 %
        ({"status": "i" * 4 + "T" * 91 + "l" * 5}, FailureKind.COVERAGE),  # 94.8 %
        ({"status": "i" * 90 + "T" * 10, "initialised_at": 90}, None),  # late, but whole
        ({"initialised_at": None}, FailureKind.NO_MAP),
        ({"ate_m": 5.01}, FailureKind.ATE),
        ({"ate_m": 4.99}, None),
        ({"ate_m": None, "path_m": None}, None),
        ({"links": (LinkError(-0.06, 0.0, 0.0),)}, FailureKind.WRONG_LINK),
        ({"links": (LinkError(0.0, 3.1, 0.0),)}, FailureKind.WRONG_LINK),
        ({"links": (LinkError(0.0, 0.0, 0.06),)}, FailureKind.WRONG_LINK),
        ({"links": (LinkError(0.04, 2.9, 0.04),)}, None),
        ({"outcome": TrialOutcome.CRASHED}, FailureKind.CRASHED),
        ({"outcome": TrialOutcome.TIMED_OUT}, FailureKind.TIMED_OUT),
    ],
)
def test_the_verdict(changes: dict[str, object], verdict: FailureKind | None) -> None:
    record: TrialRecord = replace(GOOD, **changes)  # type: ignore[arg-type]
    assert judge(record, Thresholds()) is verdict


def test_the_threshold_is_the_specs() -> None:
    record = replace(GOOD, ate_m=4.0)
    assert judge(record, Thresholds(max_ate=0.03)) is FailureKind.ATE


def test_a_crash_keeps_its_place() -> None:
    trial = plan_trials(SPEC, describe)[3]
    record = blank_record(trial, TrialOutcome.CRASHED, "it broke")
    assert TrialRecord.from_dict(record.as_dict()) == record
    with pytest.raises(ValueError, match="not the fields"):
        TrialRecord.from_dict({"key": "x"})


def loop(n: int = 200, rate_hz: float = 10.0) -> Trajectory:
    """A closed way, not flat."""
    s = np.linspace(0, 2 * np.pi, n)
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, 3] = np.column_stack([5 * np.cos(s), 3 * np.sin(s), 0.5 * np.sin(2 * s)])
    return Trajectory(np.arange(n) / rate_hz, T)


def estimate_of(truth: Trajectory, S: np.ndarray, drift: np.ndarray) -> Trajectory:
    T = truth.T_world_cam.copy()
    T[:, :3, 3] = (T[:, :3, 3] + drift) @ S[:3, :3].T + S[:3, 3]
    return Trajectory(truth.timestamps_s, T)


def similarity() -> np.ndarray:
    S = np.eye(4)
    S[:3, :3] = 0.2 * so3.exp(np.array([0.3, -0.5, 0.2]))
    S[:3, 3] = 1.0, 2.0, 3.0
    return S


@pytest.mark.parametrize("whole", [True, False])
def test_the_end_point_error_is_what_the_end_is_off_by(whole: bool) -> None:
    truth = loop()
    drift = np.zeros((len(truth), 3))
    # The last half is 0.3 m aside: laid upon the end, the whole estimate moves by that.
    drift[len(truth) // 2 :] = 0.3, 0.0, 0.0
    main = estimate_of(truth, similarity(), drift)
    ends = np.r_[0:30, 170:200]
    known = truth if whole else Trajectory(truth.timestamps_s[ends], truth.T_world_cam[ends])
    assert end_point_error(main, known) == pytest.approx(0.3, rel=1e-6)
    assert end_point_error(estimate_of(truth, similarity(), 0 * drift), known) == pytest.approx(0, abs=1e-9)


def test_no_end_point_error_without_truth_at_both_ends() -> None:
    truth = loop()
    main = estimate_of(truth, similarity(), np.zeros((len(truth), 3)))
    only_start = Trajectory(truth.timestamps_s[:15], truth.T_world_cam[:15])
    assert end_point_error(main, only_start) is None
    assert end_point_error(main, None) is None


def test_where_truth_is_there_in_parts_the_path_is_the_estimates() -> None:
    truth = loop()
    main = estimate_of(truth, similarity(), np.zeros((len(truth), 3)))
    length = float(np.linalg.norm(np.diff(truth.T_world_cam[:, :3, 3], axis=0), axis=1).sum())
    for rows in (np.arange(200), np.r_[0:30, 170:200]):
        part = Trajectory(truth.timestamps_s[rows], truth.T_world_cam[rows])
        ate_m, path_m = trajectory_error(main, part, truth.timestamps_s)
        assert ate_m == pytest.approx(0, abs=1e-9)
        assert path_m == pytest.approx(length, rel=1e-6)


@pytest.mark.slow
def test_a_recovery_of_the_real_system_is_read_from_its_events() -> None:
    world = PointWorld(cloud(), hand_held(70), covered=frozenset(range(35, 50)))
    system = system_in(world, recovery={"enabled": True, "attempts": ["live"]})
    for frame in world.frames():
        system.step(frame)
    system.finish()
    (lost,) = breakages(list(system.events))
    assert 35 <= lost.frame < 50
    assert (lost.submap, lost.attempts, lost.succeeded_at) == (0, 1, 1)
    assert lost.recovery_s is not None
    assert lost.restart_frames is not None
