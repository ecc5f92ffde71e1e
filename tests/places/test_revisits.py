"""The live system closes loops, joins maps that share no frame, and finds itself in a map of old; never wrongly."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from operator import attrgetter

import numpy as np
import pytest

from dualslam.atlas.atlas import LinkKind
from dualslam.core.events import Event, EventKind
from dualslam.core.geometry import sim3
from dualslam.core.jobs import Ended, InlineDesk, JobKind
from dualslam.core.types import Failure, FailureReason, FloatArray, FrameStatus
from dualslam.linking.join_test import drift_gate
from dualslam.places.recogniser import PlaceSearch
from dualslam.run.results import trajectories_of
from dualslam.system.places import PlaceKeeping
from dualslam.system.system import System
from dualslam.testing.late_desk import LateDesk
from dualslam.testing.point_world import PointWorld, pose_errors, system_in
from tests.places.worlds import N_LAP, N, driven_lap, lap, ring, run, wall

ROLLING = {"graph": {"max_keyframes": 25, "rollover_keyframes": 6}}
COVARIANCES = "_connections._problems.covariances"


@cache
def closed_lap() -> System:
    return run(lap())


@cache
def rolled_lap() -> System:
    return run(lap(), **ROLLING)


def late_lap(part: str, polls: int, **settings: object) -> Iterator[System]:
    """Drive the lap, not to its end: what a part of the system asks for comes after so many polls."""
    system = system_in(lap(), **settings)
    attrgetter(part)(system)._desk = LateDesk(system._state.parts.desk, polls)
    for frame in lap().frames():
        system.step(frame)
        yield system


def first_loop(system: System) -> Event:
    return system.events.of_kind(EventKind.LOOP_CLOSED)[0]


def errors(system: System) -> FloatArray:
    main = trajectories_of(system).main
    return pose_errors(main.T_world_cam, ring(N)[main.index])[0]


def test_a_loop_within_a_submap_is_closed_once_others_have_confirmed_it() -> None:
    system = closed_lap()
    loops = system.events.of_kind(EventKind.LOOP_CLOSED)
    assert loops
    assert {link.kind for link in system.atlas.believed} == {LinkKind.LOOP}
    for loop in loops:
        assert loop.submap == loop.data["other_submap"] == 0
        assert loop.data["confirmations"] == 2
        assert abs(loop.frame - N_LAP - loop.data["other_frame"]) < 25, "what is seen now was seen a lap ago"
    assert not trajectories_of(system).unlinked
    assert system.rows[N - 1].status is FrameStatus.TRACKED


def test_landmarks_of_the_loop_become_one() -> None:
    submap = closed_lap().atlas.submaps[0]
    last = max(submap.keyframes)
    seen_by, _ = submap.covisible(submap.landmark_of[last][submap.landmark_of[last] >= 0])
    assert seen_by.min() < N_LAP // 2


def test_a_loop_takes_drift_back() -> None:
    assert errors(closed_lap()).max() < errors(driven_lap()).max()


def test_a_loop_across_submaps_that_rolled_over() -> None:
    system = rolled_lap()
    assert len(system.atlas.submaps) > 2
    loops = system.events.of_kind(EventKind.LOOP_CLOSED)
    assert loops
    assert all(loop.data["other_submap"] < loop.submap for loop in loops)
    assert len(trajectories_of(system).main) == N


@pytest.mark.parametrize("what", ["loops", pytest.param("places", marks=pytest.mark.slow)])
def test_switched_off_nothing_is_asked(what: str) -> None:
    system = driven_lap() if what == "loops" else run(lap(), **{what: {"enabled": False}})
    assert not system.atlas.links
    assert not system.events.of_kind(EventKind.LOOP_CLOSED, EventKind.LOOP_REFUSED)


@pytest.mark.slow
def test_the_same_run_twice_is_the_same_to_the_bit() -> None:
    again = trajectories_of(run(lap())).main
    assert np.array_equal(again.T_world_cam, trajectories_of(closed_lap()).main.T_world_cam)


@cache
def drifted(scale_rate: float, turn_rate: float) -> tuple[float, float, float]:
    """Walk 100 steps whose scale and heading drift by a rate each step; return what `drift_gate` takes."""
    steps = np.arange(100)
    headings, scales = np.radians(turn_rate * steps), np.exp(scale_rate * steps)
    walked = (scales[:, None] * np.stack([np.cos(headings), np.sin(headings)], axis=1)).sum(axis=0)
    apart = float(np.linalg.norm(walked - [100.0, 0.0]))
    return apart / float(scales.sum()), turn_rate * 100, scale_rate * 100


@pytest.mark.parametrize(("scale_rate", "turn_rate"), [(0, 0), (0.004, 0), (-0.004, 0), (0, 0.3), (0.002, 0.2)])
def test_what_turn_and_scale_have_lost_is_drift(scale_rate: float, turn_rate: float) -> None:
    share, turn_deg, log_scale = drifted(scale_rate, turn_rate)
    assert drift_gate(share, turn_deg, log_scale).passed


def test_a_copy_of_the_place_is_no_drift() -> None:
    assert not drift_gate(0.4, 0.2, 0.003).passed  # displaced by a period, and nothing else
    assert not drift_gate(0.6, 10.0, np.log(1.5)).passed
    assert not drift_gate(0.1, 90.0, 0.0).passed


def two_maps() -> System:
    """Lost for so long that nothing of the first map is buffered; the second comes to where the first began."""
    world = lap(N + 12, covered=frozenset(range(60, 80)))
    return run(world, recovery={"enabled": True}, buffer={"duration_s": 0.3})


def test_maps_that_share_no_frame_are_merged_by_sight() -> None:
    system = two_maps()
    (merged,) = system.events.of_kind(EventKind.MERGED)
    assert (merged.submap, merged.data["other_submap"]) == (1, 0)
    assert LinkKind.MERGE in {link.kind for link in system.atlas.believed}
    main = trajectories_of(system).main
    assert main.index[0] == 0
    assert main.index[-1] == N + 11
    size = np.linalg.norm(np.ptp(ring(N)[:, :3, 3], axis=0))
    assert pose_errors(main.T_world_cam, ring(N + 12)[main.index])[0].max() < 0.05 * size


def test_the_link_of_a_place_is_measured_again_in_refined_maps() -> None:
    """The first time one side was young: its scale was 8 % off."""
    system = two_maps()
    links = system.atlas.links
    row = next(i for i, link in enumerate(links) if link.kind is LinkKind.MERGE)
    link = links[row]
    centre = system.atlas.submaps[link.b].T_submap_kf[link.keyframe_b][:3, 3]
    links[row] = replace(link, S_a_b=link.S_a_b @ sim3.from_parts(1.08, np.eye(3), -0.08 * centre))
    system.finish()
    assert links[row].attached_as(link)
    assert float(sim3.scale(links[row].S_a_b) / sim3.scale(link.S_a_b)) == pytest.approx(1.0, abs=0.03)


@pytest.mark.slow
def test_maps_that_are_apart_at_the_end_are_compared_once_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each was asked about places while it was live, of which nothing came here."""
    monkeypatch.setattr(PlaceKeeping, "note_keyframe", lambda *_: None)
    system = two_maps()
    assert system.atlas.components() == [[0], [1]]
    system.finish()
    assert [e.frame for e in system.events.of_kind(EventKind.MERGED)] == [N + 11]
    assert system.atlas.components() == [[0, 1]]
    assert pose_errors(trajectories_of(system).main.T_world_cam, ring(N + 12)[[*system.poses]])[0].max() < 0.2


@pytest.mark.slow
def test_without_recovery_a_lost_map_stays_apart() -> None:
    system = run(lap(N + 12, covered=frozenset(range(60, 80))), recovery={"enabled": False})
    assert len(system.atlas.components()) == 2


@pytest.mark.parametrize("loops", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_frames_without_a_map_are_found_in_any_submap(loops: bool) -> None:
    """A walk; back along bare walls; then a place of long ago, where the camera stands, so that no map can start."""
    there = ring(N_LAP)
    T = np.concatenate([there[:70], there[69:10:-1], np.repeat(there[10:11], 25, axis=0)])
    world = PointWorld(wall(), T, covered=frozenset(range(70, 129)))
    recovery = {"enabled": True, "relocalise_after": 5}
    system = run(world, recovery=recovery, loops={"enabled": loops}, graph=ROLLING["graph"])
    found = [e for e in system.events.of_kind(EventKind.GAP_RELOCALISED, EventKind.RELOCALISED) if e.frame >= 129]
    assert found
    assert system.rows[153].status is FrameStatus.TRACKED
    main = trajectories_of(system).main
    assert main.index[-1] == 153
    assert np.linalg.norm(main.T_world_cam[-1, :3, 3] - main.T_world_cam[10, :3, 3]) < 0.05


@pytest.mark.parametrize("polls", [pytest.param(3, marks=pytest.mark.slow), 12])
def test_a_loop_whose_covariances_come_late_is_closed_when_they_have_come(polls: int) -> None:
    *_, system = late_lap(COVARIANCES, polls)
    assert system._connections._problems.covariances._desk.n_polls[JobKind.EDGES] > polls
    system.finish()
    first, loop = first_loop(closed_lap()), first_loop(system)
    assert loop.frame > first.frame, "not before they were there"
    assert (loop.data["keyframe"], loop.data["other_frame"]) == (first.data["keyframe"], first.data["other_frame"])
    assert errors(system).max() < errors(driven_lap()).max()


@pytest.mark.parametrize(("settings", "polls"), [({}, 2), pytest.param(ROLLING, 15, marks=pytest.mark.slow)])
def test_a_loop_whose_solution_comes_late_is_closed_when_it_has_come(settings: dict[str, object], polls: int) -> None:
    *_, system = late_lap("_connections", polls, **settings)
    assert system._connections._desk.n_polls[JobKind.ATLAS] > polls
    system.finish()
    as_if = rolled_lap() if settings else closed_lap()
    first, loop = first_loop(as_if), first_loop(system)
    assert loop.frame > first.frame, "not before it was there"
    assert (loop.data["keyframe"], loop.data["other_frame"]) == (first.data["keyframe"], first.data["other_frame"])
    in_sigmas = [np.sqrt(each.data["chi2_drift"]) for each in (first, loop)]
    assert in_sigmas[1] == pytest.approx(in_sigmas[0], abs=0.1), "a tenth of a sigma adds 1 % to a variance"
    assert set(system.poses) == set(as_if.poses)
    assert errors(system).max() < max(errors(driven_lap()).max(), 1.2 * errors(as_if).max())
    assert not system._connections.is_solving


@pytest.mark.slow
def test_a_loop_that_is_being_solved_when_the_run_ends_is_closed_then() -> None:
    *_, system = late_lap("_connections", 100_000)
    assert not system.atlas.links
    system.finish()
    assert [link.kind for link in system.atlas.believed] == [LinkKind.LOOP]
    assert len(system.events.of_kind(EventKind.LOOP_CLOSED)) == 1


@pytest.mark.slow
def test_a_worker_that_dies_over_a_search_costs_that_search_alone() -> None:
    """The first two searches that would have found the loop come to nothing; those after them close it."""
    world = lap()
    system = system_in(world)
    inner, lost = system._state.parts.desk, []

    class Deadly(InlineDesk):
        def submit(self, kind: JobKind, work: PlaceSearch, of: int | None = None) -> None:
            if work.candidates and len(lost) < 2:
                lost.append(work)
                self._done[kind].append(Ended(work, Failure(FailureReason.WORKER, "it died")))
            else:
                inner.submit(kind, work)
                self._done[kind] += inner.poll(kind)

    system._revisits._desk = Deadly({})
    for frame in world.frames():
        system.step(frame)
    system.finish()
    assert len(lost) == 2
    assert first_loop(system).frame > first_loop(closed_lap()).frame
    assert len(system.poses) == len(closed_lap().poses)
    assert errors(system).max() < errors(driven_lap()).max()


def test_a_believed_place_waits_for_its_covariances_and_is_closed_when_the_run_ends() -> None:
    waits = None
    for system in late_lap(COVARIANCES, 100_000):
        believed = system._revisits._believed
        assert waits is None or believed is waits, "no other takes its place"
        waits = believed
    assert waits is not None
    assert not system.atlas.links
    system.finish()
    assert [link.kind for link in system.atlas.believed] == [LinkKind.LOOP]


@pytest.mark.slow
def test_a_lap_that_is_driven_again_and_again_closes_ever_fewer_loops() -> None:
    n = 3 * N_LAP
    system = run(PointWorld(wall(), ring(n)), **ROLLING)
    n_keyframes = sum(len(submap.keyframes) for submap in system.atlas.submaps.values())
    loops = [e.frame for e in system.events.of_kind(EventKind.LOOP_CLOSED)]
    assert loops
    assert loops[-1] > n - N_LAP, "the last lap is held as well"
    assert len(loops) < n_keyframes / 30, "what was told a moment ago is not told again"
    main = trajectories_of(system).main
    size = np.linalg.norm(np.ptp(ring(n)[:, :3, 3], axis=0))
    assert pose_errors(main.T_world_cam, ring(n)[main.index])[0].max() < 0.05 * size
