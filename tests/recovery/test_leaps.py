"""A leap over missing frames is held against the velocities on either side, and against what the run does elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.core.events import EventKind
from dualslam.core.types import FailureReason, FloatArray
from dualslam.recovery.leaps import MIN_ASKED, measure_leap, refuse_leaps
from dualslam.testing.point_world import PointWorld, cloud, hand_held, system_in
from tests.recovery.test_schedule import Watched

RATE_HZ = 20.0


def way(n: int, seed: int, sway_m: float = 0.05) -> tuple[FloatArray, FloatArray]:
    """A hand that walks on, swaying."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) / RATE_HZ
    phase, omega = rng.uniform(0, 6, 3), rng.uniform(3, 7, 3)
    return t, np.outer(t, [0.8, 0.0, 0.3]) + sway_m * np.sin(np.outer(t, omega) + phase)


def without(t: FloatArray, p: FloatArray, start: int, length: int) -> tuple[FloatArray, FloatArray]:
    kept = np.r_[:start, start + length : len(t)]
    return t[kept], p[kept]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("length", [6, 20])
def test_a_right_leap_is_believed_in_any_unit(seed: int, length: int) -> None:
    t, p = without(*way(160, seed), 100, length)
    for unit in (1.0, 1e-3, 1e3):
        leap = measure_leap(t, unit * p, 99)
        assert leap is not None
        assert leap.n_asked >= MIN_ASKED
        assert not leap.is_refused


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("off_m", [-1.5, 1.5])
def test_one_that_is_a_period_off_is_not(seed: int, off_m: float) -> None:
    t, p = without(*way(160, seed), 100, 10)
    p[100:, 0] += off_m
    leap = measure_leap(t, p, 99)
    assert leap is not None
    assert leap.is_refused


@pytest.mark.parametrize("seed", range(4))
def test_what_a_map_itself_has_leapt_is_nothing_that_its_camera_does(seed: int) -> None:
    """A start that was found again with a jump: it must not let a jump pass later."""
    t, p = way(160, seed, sway_m=0.02)
    p[:10, 0] -= 0.6
    t, p = without(t, p, 90, 10)
    refound = np.arange(len(t)) == 10
    right = measure_leap(t, p, 89, refound)
    assert right is not None
    assert right.n_asked >= MIN_ASKED
    assert not right.is_refused
    p[90:, 0] += 0.6
    wrong = measure_leap(t, p, 89, refound)
    assert wrong is not None
    assert wrong.is_refused
    blind = measure_leap(t, p, 89)
    assert blind is not None
    assert not blind.is_refused, "the first jump is what shows the second to be none"


def test_where_the_run_can_tell_nothing_nothing_is_refused() -> None:
    t, p = without(*way(40, 1), 12, 10)
    p[12:, 0] += 1.5
    leap = measure_leap(t, p, 11)
    assert leap is None or not leap.is_refused
    t, p = without(*way(200, 1), 100, 60)  # three seconds
    assert measure_leap(t, p, 99) is None
    t, p = way(100, 1)
    assert measure_leap(t, p, 50) is None


@pytest.mark.parametrize("seed", range(4))
def test_a_walk_that_has_leapt_is_judged_by_the_lost_map(seed: int) -> None:
    t, p = way(200, seed)
    old, new = slice(0, 100), slice(80, 200)
    t_new, p_new = without(t[new], p[new], 30, 10)
    assert refuse_leaps(t_new, p_new, t[old], p[old]) is None
    p_new[:30, 0] -= 1.5
    refused = refuse_leaps(t_new, p_new, t[old], p[old])
    assert refused is not None
    assert refused.reason is FailureReason.LEAP
    assert refuse_leaps(t_new, p_new, t[old][:5], p[old][:5]) is None


@pytest.mark.parametrize("walked_from", [None, 95])
def test_a_map_that_has_leapt_as_its_camera_never_moves_ends_there(walked_from: int | None) -> None:
    """Also where a walk from the frame that was found has posed those back to the leap."""
    T = hand_held(130)
    T[90:, 0, 3] += 2.5  # what a period would do
    missing = range(80, 90)
    world = PointWorld(cloud(), T)
    system = system_in(world)
    for frame in world.frames():
        if frame.index == walked_from:
            system._state.leaps.begin(frame)
        if frame.index not in missing:
            system.step(frame)
    system.finish()
    failed = system.events.of_kind(EventKind.FAILED)
    assert [event.data["reason"] for event in failed] == ["leap"]
    assert failed[0].data["lost_since"] == 90
    assert failed[0].data["suspected_since"] >= 90
    assert min(system.atlas.submaps[0].condemned) >= 90
    assert all(k < 90 or k in system.atlas.submaps[0].condemned for k in system.atlas.submaps[0].keyframes)
    assert not any(pose.submap_id == 0 and pose.index >= 90 for pose in system.poses.values())


def test_what_a_map_saw_beyond_its_leap_takes_no_part_in_a_link() -> None:
    T = hand_held(150)
    T[90:, 0, 3] += 2.5
    world = PointWorld(cloud(), T)
    system = system_in(world, recovery={"attempts": ["live"]})
    system._recoveries._executor = watched = Watched(system._recoveries._executor)
    for frame in world.frames():
        if not 80 <= frame.index < 90:
            system.step(frame)
    old = system.atlas.submaps[0]
    assert min(old.condemned) >= 90, "the map itself stays whole"
    jobs = [job for job in watched.jobs if 0 in job.lost]
    assert jobs
    for job in jobs:
        lost = job.lost[0]
        assert lost.keyframes.keys() == old.keyframes.keys() - old.condemned
        assert not lost.condemned
        alive = np.flatnonzero(lost.landmarks["alive"])
        assert lost.n_observations(alive).min() >= 2
