"""What a system that cannot keep up leaves out, and that one without a clock leaves out nothing."""

from __future__ import annotations

import pytest

from dualslam.pace import BEHIND_S, MAX_LAG_KEYFRAMES, MAX_PUT_OFF, Pace
from dualslam.testing.point_world import PointWorld, cloud, hand_held, system_in

MANY, WEAK = 300, 60


def test_without_real_time_no_keyframe_is_put_off() -> None:
    pace = Pace()
    assert not pace.may_lag(100)
    assert pace.may_lag(MAX_LAG_KEYFRAMES)
    assert not pace.behind
    assert not pace.puts_off(MANY, WEAK)


def test_a_keyframe_is_put_off_while_frames_are_late_and_no_longer_than_that() -> None:
    pace = Pace()
    pace.note(0.0)
    assert not pace.puts_off(MANY, WEAK)
    pace.note(1.5 * BEHIND_S)
    assert [pace.puts_off(MANY, WEAK) for _ in range(MAX_PUT_OFF + 2)] == [True] * MAX_PUT_OFF + [False, True]
    pace.note(0.0)
    assert not pace.puts_off(MANY, WEAK)
    assert pace.statistics.put_off == MAX_PUT_OFF + 1
    assert pace.statistics.behind == 1


def test_nor_while_the_graph_has_much_to_learn() -> None:
    pace = Pace()
    pace.note(0.0)
    assert pace.may_lag(MAX_LAG_KEYFRAMES)
    assert not pace.behind
    assert pace.may_lag(MAX_LAG_KEYFRAMES + 1)
    assert pace.puts_off(MANY, WEAK)
    assert pace.statistics.max_lag_keyframes == MAX_LAG_KEYFRAMES + 1


def test_what_would_be_lost_without_new_landmarks_gets_them() -> None:
    pace = Pace()
    pace.note(1.0)
    assert not pace.puts_off(WEAK, WEAK)
    assert pace.puts_off(MANY, WEAK)


@pytest.mark.slow
def test_a_system_that_is_behind_makes_fewer_keyframes_and_keeps_its_track() -> None:
    world = PointWorld(cloud(), hand_held(60))
    dense = {"keyframes": {"max_parallax_deg": 1.0}, "mapping": {"redundant_ratio": 1.0}}
    systems = [system_in(world, **dense) for _ in range(2)]
    for system, late_s in zip(systems, (0.0, 1.0), strict=True):
        for frame in world.frames():
            if frame.index == 10:  # there is a map
                system.pace.note(late_s)
            system.step(frame)
    counts = [len(system.atlas.submaps[0].keyframes) for system in systems]
    assert counts[1] < 0.5 * counts[0]
    assert all(len(system.poses) == len(systems[0].poses) for system in systems)
