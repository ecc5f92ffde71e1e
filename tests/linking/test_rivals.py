"""Of several poses beyond a gap one is believed where the velocities allow it and clearly none of the others."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.atlas.trajectory import FramePose, Path
from dualslam.core.types import FailureReason, FloatArray, Rival
from dualslam.linking.rivals import choose_by_velocity
from dualslam.map.submap import Submap
from tests.linking.test_motion import RATE_HZ, way, without

PERIOD_M = 1.5
KNOWN = slice(0, 110)
"""What the lost map has posed; frames 110 to 119 are missing, and the walk comes from 120 on and goes back to 60."""


def path(t: FloatArray, p: FloatArray) -> Path:
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, 3] = p
    return Path(np.round(t * RATE_HZ).astype(np.int64), t, T, np.zeros(len(t), bool))


def walk(t: FloatArray, p: FloatArray, back_at: int, off_m: float = 0.0) -> Path:
    """The path of a walk that finds its place again at a frame beyond the gap, and is some way off from there on."""
    t, p = without(t[60:200], p[60:200].copy(), back_at - 59, 119 - back_at)
    p[: back_at - 59, 0] += off_m
    return path(t, p)


def rival(frame: int, off_m: float) -> Rival:
    T = np.eye(4)
    T[0, 3] = -off_m
    return Rival(frame, T, np.eye(4))


@pytest.mark.parametrize("back_at", [109, 95])
def test_the_right_one_is_believed(back_at: int) -> None:
    """Also where the walk has found its place only a while beyond the gap."""
    for seed in range(12):
        t, p = way(200, seed)
        off = (PERIOD_M, -PERIOD_M, 2 * PERIOD_M)
        rivals = [rival(frame, each) for frame in (back_at, back_at - 1) for each in off]
        choice = choose_by_velocity(walk(t, p, back_at), path(t[KNOWN], p[KNOWN]), rivals)
        assert choice.refusal is None
        assert not choice.better


@pytest.mark.parametrize("back_at", [109, 95])
def test_where_the_walk_has_taken_a_wrong_one_the_right_one_is_told(back_at: int) -> None:
    for seed in range(12):
        t, p = way(200, seed)
        known = p[KNOWN] + [PERIOD_M, 0.0, 0.0]  # where the walk's wrong pose puts the lost map
        rivals = [rival(frame, each) for frame in (back_at, back_at - 1) for each in (-PERIOD_M, PERIOD_M)]
        choice = choose_by_velocity(walk(t, p, back_at, PERIOD_M), path(t[KNOWN], known), rivals)
        assert choice.refusal is not None
        assert choice.refusal.reason is FailureReason.LEAP
        told = [(each.index, float(each.T_rival_walked[0, 3])) for each in choice.better]
        assert told == [(back_at, -PERIOD_M), (back_at - 1, -PERIOD_M)]


@pytest.mark.parametrize("off_m", [0.0, PERIOD_M])
def test_nothing_is_told_where_the_camera_may_have_come_to_two(off_m: float) -> None:
    t, p = way(200, 1)
    known = path(t[KNOWN], p[KNOWN] + [off_m, 0.0, 0.0])
    period = 0.06  # the sway of the hand
    rivals = [rival(109, off_m + each) for each in (period, -period, PERIOD_M)]
    choice = choose_by_velocity(walk(t, p, 109, off_m), known, [*rivals, rival(109, PERIOD_M)])
    assert choice.refusal is not None
    assert choice.refusal.reason is FailureReason.LOOK_ALIKE
    assert choice.is_measured
    assert not choice.better


def test_one_is_not_believed_where_one_that_is_not_found_may_be_the_right_one() -> None:
    """All that are found are refused but one; but a period on from that, on the other side, there may be another."""
    t, p = way(200, 1)
    off_m, period_m = 0.4, 1.0
    known = path(t[KNOWN], p[KNOWN] + [off_m, 0.0, 0.0])
    choice = choose_by_velocity(walk(t, p, 109, off_m), known, [rival(109, 2 * period_m), rival(109, period_m)])
    assert choice.refusal is not None
    assert choice.refusal.reason is FailureReason.LOOK_ALIKE


@pytest.mark.parametrize("case", ["little is known", "three seconds", "no frame beyond", "no gap"])
def test_nothing_is_told_where_nothing_can_be_measured(case: str) -> None:
    t, p = way(260, 1)
    walked, known = walk(t, p, 109), path(t[KNOWN], p[KNOWN])
    rivals = [rival(109, PERIOD_M)]
    if case == "little is known":
        known = path(t[100:110], p[100:110])
    elif case == "three seconds":
        walked = path(*without(t[60:], p[60:], 50, 60))
    elif case == "no frame beyond":
        walked, known = path(t[120:], p[120:]), path(t[:0], p[:0])
    else:
        walked = path(t[60:], p[60:])
    choice = choose_by_velocity(walked, known, rivals)
    assert choice.refusal is not None
    assert choice.refusal.reason is FailureReason.LOOK_ALIKE
    assert not choice.better


def read_from_its_end(way: Path) -> Path:
    """The same frames in the same order, by falling timestamps, in a map of one keyframe."""
    submap = Submap(0, np.eye(3), np.zeros(32, np.uint8))
    submap.T_submap_kf[0] = np.eye(4)
    frames = zip(way.index.tolist(), way.times_s.tolist(), way.T_map_cam, strict=True)
    return Path.of([FramePose(i, 100.0 - t, 0, 0, T) for i, t, T in frames], submap)


@pytest.mark.parametrize("off_m", [0.0, PERIOD_M])
def test_a_source_that_is_read_from_its_end_tells_the_same(off_m: float) -> None:
    for seed in range(6):
        t, p = way(200, seed)
        walked, known = walk(t, p, 109, off_m), path(t[KNOWN], p[KNOWN] + [off_m, 0.0, 0.0])
        rivals = [rival(109, each) for each in (-PERIOD_M, PERIOD_M)]
        choice = choose_by_velocity(walked, known, rivals)
        other = choose_by_velocity(read_from_its_end(walked), read_from_its_end(known), rivals)
        assert (choice.refusal is None) == (off_m == 0.0)
        assert (other.refusal is None) == (off_m == 0.0)
        assert [each.T_cam_rival[0, 3] for each in other.better] == [each.T_cam_rival[0, 3] for each in choice.better]
        assert len(other.better) == (off_m != 0.0)
