"""Motion across a gap or a seam is compared with the velocities on either side, and with the rest of the run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.atlas.trajectory import Path
from dualslam.core.events import EventKind
from dualslam.core.geometry import sim3
from dualslam.core.types import Failure, FailureReason, FloatArray
from dualslam.linking.join_test import judge_motion
from dualslam.linking.motion import (
    MIN_ASKED,
    TAIL,
    WINDOW_FRAMES,
    Motion,
    Slack,
    find_reached,
    gaps_of,
    join_slack,
    measure_motion,
    seam_motions,
    step_motions,
)
from dualslam.testing.point_world import PointWorld, cloud, hand_held, system_in
from dualslam.testing.walks import WatchedWalks, replace_walks

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


def path_of(t: FloatArray, p: FloatArray) -> Path:
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, 3] = p
    return Path(np.round(t * RATE_HZ).astype(np.int64), t, T, np.zeros(len(t), bool))


def refuse_gaps(path: Path, known: Path) -> Failure | None:
    return judge_motion(step_motions(path, gaps_of(path.times_s), known)).refusal()


def refuse_seams(old: Path, new: Path, slack: Slack = lambda i, j: 0.0) -> Failure | None:
    return judge_motion(seam_motions(old, new, slack)).refusal()


def motion_behind(path: Path, row: int) -> Motion:
    """The motion across a gap, judged by what came before it."""
    motion = measure_motion(path, row, path.take(np.arange(len(path)) <= row))
    assert motion is not None
    return motion


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("length", [6, 20, 60, 200])
def test_a_right_motion_is_believed_in_any_unit(seed: int, length: int) -> None:
    """Also over gaps that are longer than the history."""
    t, p = without(*way(140 + length, seed), 100, length)
    for unit in (1.0, 1e-3, 1e3):
        motion = motion_behind(path_of(t, unit * p), 99)
        assert motion.n_asked >= MIN_ASKED
        assert not motion.is_refused


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("off_m", [-1.5, 1.5])
@pytest.mark.parametrize(("length", "sway_m"), [(10, 0.05), (38, 0.005), (42, 0.005), (80, 0.002)])
def test_one_that_is_a_period_off_is_not(seed: int, off_m: float, length: int, sway_m: float) -> None:
    """Nothing changes at two seconds, nor where the history is too short to be asked over so long a time.

    A period too little may be a halt, where the history is less than twice as long as the gap.
    """
    t, p = without(*way(160 + length, seed, sway_m), 100, length)
    p[100:, 0] += off_m
    for first in (0, 60) if off_m > 0 or length <= 10 else (0,) if length <= 50 else ():
        motion = motion_behind(path_of(t[first:], p[first:]), 99 - first)
        assert motion.n_asked >= MIN_ASKED
        assert motion.is_refused


@pytest.mark.parametrize("seed", range(4))
def test_what_is_known_of_a_motion_fades_with_the_gap(seed: int) -> None:
    """A history of two seconds forbids ever less, and a day later nothing within a kilometre."""
    allowed = []
    for gap_s in (0.5, 2.0, 10.0, 60.0, 86400.0):
        t, p = way(140, seed, sway_m=0.02)
        t[100:] += gap_s
        motion = motion_behind(path_of(t[60:], p[60:]), 39)
        allowed.append(motion.allowed_mu)
    assert (np.diff(allowed) > 0).all()
    assert allowed[0] < 0.5
    assert allowed[-1] > 1000


@pytest.mark.parametrize("seed", range(4))
def test_a_jump_of_the_map_does_not_count_as_motion_of_its_camera(seed: int) -> None:
    """A start that was found again with a jump must not excuse a jump later."""
    t, p = way(160, seed, sway_m=0.02)
    p[:10, 0] -= 0.6
    t, p = without(t, p, 90, 10)
    path = replace(path_of(t, p), refound=np.arange(len(t)) == 10)
    assert not motion_behind(path, 89).is_refused
    path.T_map_cam[90:, 0, 3] += 0.6
    assert motion_behind(path, 89).is_refused
    blind = motion_behind(replace(path, refound=np.zeros(len(t), bool)), 89)
    assert not blind.is_refused, "the first jump is what shows the second to be none"


def test_a_change_of_velocity_explains_what_it_can() -> None:
    """A camera that has rested until now is off by half the way that its new velocity leads: it may have started at any
    time. What lies beyond is refused."""
    t = np.arange(140) / RATE_HZ
    p = np.outer(np.maximum(t - t[109], 0.0), [0.8, 0.0, 0.0])
    p += 1e-4 * np.random.default_rng(1).normal(size=p.shape)
    t, p = without(t, p, 100, 20)
    assert not motion_behind(path_of(t, p), 99).is_refused
    p[100:, 0] += 1.0
    assert motion_behind(path_of(t, p), 99).is_refused


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("across_m", "refused"), [(0.0, False), (0.3, True), (-0.3, True)])
def test_a_change_of_velocity_displaces_along_itself(seed: int, across_m: float, refused: bool) -> None:
    """A map that was found again at a similar place, and is bent there, excuses no error by its own velocity."""
    t, p = way(140, seed, sway_m=0.002)
    v, changed = np.array([0.8, 0.0, 0.3]), np.array([0.3, 0.0, -0.2])
    t, p = without(t, p, 100, 12)
    p[100:] = p[99] + 0.5 * (t[100] - t[99]) * (v + changed) + np.outer(t[100:] - t[100], changed)
    p[100:] += across_m * np.array([0.0, 1.0, 0.0])
    assert motion_behind(path_of(t, p), 99).is_refused is refused


@pytest.mark.parametrize("gap_s", [0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("turn_deg", [45.0, 90.0, 180.0])
def test_a_camera_may_turn_unseen(gap_s: float, turn_deg: float) -> None:
    """A car that has gone straight on takes a bend within the gap."""
    length = round(RATE_HZ * gap_s)
    heading = np.radians(np.interp(np.arange(180 + length), [100, 100 + length], [0.0, turn_deg]))
    steps = np.column_stack([np.cos(heading), np.zeros(len(heading)), np.sin(heading)]) / RATE_HZ
    p = np.cumsum(steps, axis=0) + np.random.default_rng(1).normal(0, 1e-3, steps.shape)
    t, p = without(np.arange(len(p)) / RATE_HZ, p, 100, length)
    assert not motion_behind(path_of(t, p), 99).is_refused


@pytest.mark.parametrize("seed", range(4))
def test_a_camera_may_halt_for_as_long_as_it_was_not_watched(seed: int) -> None:
    """A robot at constant speed stops dead while nothing is seen, and goes on slowly.

    One that goes on as before is refused: it may as well be at the next of several like places.
    """
    for gap_s, halt_s, speed, refused in (
        (4.0, 2.5, 0.3, False),
        (4.0, 2.5, 0.0, False),
        (4.0, 2.5, 1.0, True),
        (4.0, -2.5, 1.0, True),
        (1.0, 0.8, 1.0, True),
    ):
        t, p = way(180, seed, sway_m=0.002)
        length = round(RATE_HZ * gap_s)
        t, p = without(np.arange(180 + length) / RATE_HZ, np.concatenate([p, np.zeros((length, 3))]), 100, length)
        p[100:] = p[99] + speed * np.outer(t[100:] - t[99] - halt_s, [0.8, 0.0, 0.3])
        assert motion_behind(path_of(t[20:], p[20:]), 79).is_refused is refused


@pytest.mark.parametrize("seed", range(4))
def test_a_camera_that_brakes_right_behind_a_gap_is_believed(seed: int) -> None:
    """Its velocity is measured over a window: it has changed until the middle of that."""
    t = np.arange(80) / RATE_HZ
    speed = np.interp(t, [0, 2.5, 3.0], [1.0, 1.0, 0.0])
    p = np.outer(np.cumsum(speed) / RATE_HZ, [1.0, 0.0, 0.0]) + np.random.default_rng(seed).normal(0, 1e-3, (80, 3))
    t, p = without(t, p, 40, 10)
    assert not motion_behind(path_of(t, p), 39).is_refused


def test_where_the_run_can_tell_nothing_nothing_is_refused() -> None:
    t, p = without(*way(24, 1), 6, 10)
    p[6:, 0] += 1.5
    assert not motion_behind(path_of(t, p), 5).is_refused


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("frames_beyond", [1, 3, 30])
def test_one_velocity_is_enough(seed: int, frames_beyond: int) -> None:
    t, p = way(160, seed)
    t, p = without(t[: 110 + frames_beyond], p[: 110 + frames_beyond], 100, 10)
    assert not motion_behind(path_of(t, p), 99).is_refused
    p[100:, 0] += 1.5
    motion = motion_behind(path_of(t, p), 99)
    assert motion.n_sides == (2 if frames_beyond > WINDOW_FRAMES else 1)
    assert motion.is_refused


@pytest.mark.parametrize("seed", range(4))
def test_reverse_tracking_across_a_gap_is_judged_by_the_lost_map(seed: int) -> None:
    t, p = way(200, seed)
    old, new = slice(0, 100), slice(80, 200)
    t_new, p_new = without(t[new], p[new], 30, 10)
    known = path_of(t[old], p[old])
    assert refuse_gaps(path_of(t_new, p_new), known) is None
    p_new[:30, 0] -= 1.5
    refused = refuse_gaps(path_of(t_new, p_new), known)
    assert refused is not None
    assert refused.reason is FailureReason.LEAP
    assert refuse_gaps(path_of(t_new, p_new), path_of(t[old][:5], p[old][:5])) is None


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("interleaved", [False, True])
def test_a_seam_is_judged_where_no_frame_is_missing(seed: int, interleaved: bool) -> None:
    t, p = way(200, seed, sway_m=0.02)
    of_new = np.arange(200) >= 100
    if interleaved:
        of_new[[97, 98, 101]] = [True, True, False]
    for off_m, refused in ((0.0, False), (0.4, True), (-1.5, True)):
        moved = p + np.outer(of_new, [off_m, 0.0, 0.0])
        whole = path_of(t, moved)
        assert (refuse_seams(whole.take(~of_new), whole.take(of_new)) is not None) is refused
        assert refuse_seams(whole.take(~of_new), whole.take(of_new), lambda i, j: 2.0) is None


def test_a_seam_behind_a_corrupted_tail_is_believed() -> None:
    """The frames before a loss are wrong already: without them the two maps fit."""
    t, p = way(200, 2, sway_m=0.02)
    p[96:100, 1] += [0.1, 0.3, 0.6, 1.0]
    whole = path_of(t, p)
    old, new = whole.take(np.arange(200) < 100), whole.take(np.arange(200) >= 100)
    assert refuse_seams(old, new) is None
    assert refuse_seams(old.take(np.arange(100) < 95), replace(new, T_map_cam=new.T_map_cam + 1.0)) is not None


@pytest.mark.parametrize("seed", range(6))
def test_what_hangs_loosely_beside_a_step_that_the_camera_cannot_make_is_not_reached(seed: int) -> None:
    """Frames that are not known lie between, behind and among known ones; ten of them are where they are not."""
    t, p = way(160, seed)
    is_known = np.zeros(160, bool)
    is_known[[*range(60), *range(80, 100)]] = True
    known = path_of(t, p).take(is_known)
    assert find_reached(path_of(t, p), is_known, known, 0.1 * ~is_known).all()
    wrong = np.arange(120, 130)
    p[wrong] += [0.0, 1.5, 0.0]
    firm, loose = 0.1 * ~is_known, 0.1 * ~is_known
    loose[wrong], firm[130:] = 0.2, 0.3
    reached = find_reached(path_of(t, p), is_known, known, loose)
    assert not reached[wrong].any()
    assert reached[:118].all()
    assert reached[132:].all(), "they see more of what known frames have seen"
    reached = find_reached(path_of(t, p), is_known, known, firm)
    assert not reached[132:].any()


def test_a_jump_between_frames_that_known_ones_surround_is_found() -> None:
    t, p = way(120, 1)
    is_known = np.ones(120, bool)
    is_known[50:70] = False
    wrong = np.arange(60, 70)
    known = path_of(t, p).take(is_known)
    p[wrong] += [0.0, 1.5, 0.0]
    reached = find_reached(path_of(t, p), is_known, known, np.where(is_known, 0.0, 0.1))
    assert not reached[wrong[2:]].any()
    assert reached[is_known].all()


def test_known_frames_before_a_torn_step_may_be_corrupted_themselves() -> None:
    t, p = way(120, 3)
    is_known = np.arange(120) < 80
    p[80 - TAIL : 80] += [0.0, 0.0, 1.0]
    path = path_of(t, p)
    assert find_reached(path, is_known, path.take(np.arange(120) < 80 - TAIL), 0.1 * ~is_known).all()


def test_what_a_join_leaves_open_is_that_of_its_similarity_at_the_place() -> None:
    S = sim3.exp([0.2, -0.1, 0.4, 1.0, 2.0, -0.5, 0.7])
    sigma = np.array([0.01, 0.02, 0.005, 0.03, 0.01, 0.02, 0.04])
    rng = np.random.default_rng(0)
    place_src = np.array([2.0, -1.0, 5.0])
    samples = np.array([sim3.act(S @ sim3.exp(sigma * rng.normal(size=7)), place_src[None])[0] for _ in range(4000)])
    widest = float(np.sqrt(np.linalg.eigvalsh(np.cov(samples.T))[-1]))
    slack = join_slack(S, np.diag(sigma**2), sim3.act(S, place_src[None])[0])
    assert slack == pytest.approx(3.0 * widest, rel=0.1)


@pytest.mark.parametrize("walked_from", [None, 50])
def test_a_map_that_has_leapt_as_its_camera_never_moves_ends_there(walked_from: int | None) -> None:
    """Also where a walk from the frame that was found has posed those back to the leap."""
    T = hand_held(75)
    T[45:, 0, 3] += 2.5  # what a period would do
    missing = range(35, 45)
    world = PointWorld(cloud(), T)
    system = system_in(world)
    for frame in world.frames():
        if frame.index == walked_from:
            system._state.motion_watch.begin(frame)
        if frame.index not in missing:
            system.step(frame)
    system.finish()
    failed = system.events.of_kind(EventKind.FAILED)
    assert [event.data["reason"] for event in failed] == ["leap"]
    assert failed[0].data["lost_since"] == 45
    assert failed[0].data["suspected_since"] >= 45
    assert min(system.atlas.submaps[0].condemned) >= 45
    assert all(k < 45 or k in system.atlas.submaps[0].condemned for k in system.atlas.submaps[0].keyframes)
    assert not any(pose.submap_id == 0 and pose.index >= 45 for pose in system.poses.values())


def test_what_a_map_saw_beyond_its_leap_takes_no_part_in_a_link() -> None:
    T = hand_held(95)
    T[45:, 0, 3] += 2.5
    world = PointWorld(cloud(), T)
    system = system_in(world, recovery={"attempts": ["live"]})
    watched = replace_walks(system, WatchedWalks)
    for frame in world.frames():
        if not 35 <= frame.index < 45:
            system.step(frame)
    old = system.atlas.submaps[0]
    assert min(old.condemned) >= 45, "the map itself stays whole"
    jobs = [job for job in watched.jobs if 0 in job.lost]
    assert jobs
    for job in jobs:
        lost = job.lost[0]
        assert lost.keyframes.keys() == old.keyframes.keys() - old.condemned
        assert not lost.condemned
        alive = np.flatnonzero(lost.landmarks["alive"])
        assert lost.n_observations(alive).min() >= 2
