"""What a system that cannot keep up leaves out, and that one without a clock leaves out nothing."""

from __future__ import annotations

import pytest

from dualslam.places.revisits import Revisits
from dualslam.system.pace import BEHIND_S, FAR_BEHIND_KEYFRAMES, MAX_PUT_OFF, Pace
from dualslam.testing.point_world import PointWorld, cloud, hand_held, system_in

MANY, WEAK = 300, 60


def test_without_real_time_no_keyframe_is_put_off() -> None:
    pace = Pace()
    pace.note_lag(100)
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


def test_what_comes_in_before_a_frame_makes_it_late_as_well() -> None:
    pace = Pace()
    pace.hold_up(1.0)
    assert not pace.behind
    pace.note(0.5 * BEHIND_S)
    pace.hold_up(0.8 * BEHIND_S)
    assert pace.puts_off(MANY, WEAK)
    pace.note(0.0)
    assert not pace.behind


@pytest.mark.parametrize("late_s", [None, 0.0, 2 * BEHIND_S], ids=["inline", "in time", "late"])
def test_buffered_views_follow_a_change_while_frames_come_in_time(late_s: float | None) -> None:
    world = PointWorld(cloud(), hand_held(40))
    system = system_in(world)
    changed: list[int] = []
    for frame in world.frames():
        if frame.index == 30:
            system.buffer.map_later(lambda view: changed.append(view.index) or view, "test")  # type: ignore[func-returns-value]
        if late_s is not None:
            system.pace.note(late_s)
        system.step(frame)
    if late_s == 2 * BEHIND_S:
        assert not changed
    list(system.buffer)  # whoever looks at them sees them changed
    assert sorted(changed) == list(range(30))


def test_nor_while_the_graph_has_much_to_learn() -> None:
    pace = Pace()
    pace.note(0.0)
    pace.note_lag(FAR_BEHIND_KEYFRAMES)
    assert not pace.behind
    pace.note_lag(FAR_BEHIND_KEYFRAMES + 1)
    assert pace.puts_off(MANY, WEAK)
    assert pace.statistics.max_lag_keyframes == FAR_BEHIND_KEYFRAMES + 1


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


@pytest.mark.parametrize("late_s", [None, 0.0, 2 * BEHIND_S], ids=["inline", "in time", "late"])
def test_places_are_asked_for_with_the_frame_after_a_keyframe_that_comes_in_time(
    late_s: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a clock with the keyframe's own; where the frames are late, with the next keyframe at the latest."""
    world = PointWorld(cloud(), hand_held(40))
    system = system_in(world, keyframes={"max_parallax_deg": 1.0})
    now, asked = [-1], []
    monkeypatch.setattr(Revisits, "note_keyframe", lambda _, live, n: asked.append((live.reference_id, now[0])))
    for frame in world.frames():
        now[0] = frame.index
        if late_s is not None:
            system.pace.note(late_s)
        system.step(frame)
    system.finish()
    assert asked
    waits = [at - keyframe for keyframe, at in asked]
    if late_s is None:
        assert set(waits) == {0}
    elif late_s == 0.0:
        assert 1 in waits
        assert set(waits) <= {0, 1}  # two keyframes in a row: the second asks
    else:
        assert set(waits) == {0}


def test_in_real_time_no_frame_takes_more_than_its_share_of_landmarks_into_the_index(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = PointWorld(cloud(), hand_held(40))
    system = system_in(world, keyframes={"max_parallax_deg": 1.0})
    index = system._revisits._recogniser
    monkeypatch.setattr("dualslam.system.places.TAKEN_IN_A_FRAME", 20)
    grown = []
    for frame in world.frames():
        system.pace.note(0.0)
        before = len(index)
        system.step(frame)
        grown.append(len(index) - before)
    assert sum(grown) > 100
    assert max(grown) <= 2 * 20  # a frame that takes its share in may be asked about, too
