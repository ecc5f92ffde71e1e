"""The state machine on scenes of points: every frame accounted for, whatever happens to it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from dualslam.backend.atlas_solver import GtsamAtlasSolver
from dualslam.core.atlas_problem import AtlasProblem, AtlasSolution
from dualslam.core.bundle import FrameRows
from dualslam.core.config.settings import RecoveryConfig
from dualslam.core.errors import SolverError
from dualslam.core.events import EventKind
from dualslam.core.types import Features, FloatArray, FrameStatus, Track, View
from dualslam.lab.bench.measure import breakages
from dualslam.map.submap import Submap
from dualslam.places.sightings import Relocalised, Sightings
from dualslam.run.results import frame_rows, trajectories_of
from dualslam.system.starting import EARLY_FRAMES
from dualslam.system.system import System
from dualslam.testing.point_world import RATE_HZ, PointWorld, cloud, hand_held, path, pose_errors, system_in

POSITION_M, ROTATION_RAD = 0.06, 0.01


def run(world: PointWorld, **settings: object) -> System:
    system = system_in(world, **settings)
    for frame in world.frames():
        system.step(frame)
    system.finish()
    return system


def main_trajectory(system: System) -> tuple[list[int], FloatArray]:
    main = trajectories_of(system).main
    return main.index.tolist(), main.T_world_cam


def assert_right(indices: list[int], T: FloatArray, world: PointWorld) -> None:
    translation, rotation = pose_errors(T, world.T_world_cam[indices])
    assert translation.max() < POSITION_M
    assert rotation.max() < ROTATION_RAD


def kinds(system: System) -> list[EventKind]:
    return [event.event for event in system.events]


@pytest.fixture(scope="module")
def world() -> PointWorld:
    return PointWorld(cloud(600), hand_held(70))


@pytest.fixture(scope="module")
def short(world: PointWorld) -> PointWorld:
    return PointWorld(world.xyz, world.T_world_cam[:40])


@pytest.fixture(scope="module")
def plain(world: PointWorld) -> System:
    return run(world)


def ended(
    world: PointWorld, refine: Callable[[Submap], object], interrupted: bool = False, forget: bool = False
) -> System:
    """A run whose maps are refined at its end by something else; `forget`: what its frames have seen is lost."""
    system = system_in(world)
    for frame in world.frames():
        system.step(frame)
    if forget:
        system._state.record.observations.clear()

    def refine_at_end(submap: Submap, *, frames: FrameRows) -> float:
        assert len(frames.T_submap_cam) == (0 if forget else len(submap.keyframes))
        refine(submap)
        return 1.0

    system._state.parts = replace(system._state.parts, refine_at_end=refine_at_end)
    system.finish(interrupted)
    return system


def test_a_run_that_is_over_holds_no_frames(plain: System) -> None:
    assert plain.buffer.peak_bytes > 0
    assert (len(plain.buffer), plain.buffer.nbytes) == (0, 0)


@pytest.mark.parametrize("interrupted", [False, True])
def test_each_map_is_refined_once_at_the_end_unless_someone_waits(short: PointWorld, interrupted: bool) -> None:
    refined: list[int] = []
    ended(short, lambda submap: refined.append(submap.id), interrupted)
    assert refined == ([] if interrupted else [0])


def test_frames_follow_the_refinement(short: PointWorld) -> None:
    """Each keyframe a little farther to the side than the one before: frames between two go the way between theirs."""

    def shear(submap: Submap) -> None:
        for k, T in submap.T_submap_kf.items():
            T[:3, 3] += [0.0, 0.0, 0.01 * k]

    (index, T), (_, T_as_it_was) = (
        main_trajectory(ended(short, refine, forget=True)) for refine in (shear, lambda submap: None)
    )
    moved = T[:, :3, 3] - T_as_it_was[:, :3, 3]
    np.testing.assert_allclose(moved[:, :2], 0.0, atol=0.01)
    np.testing.assert_allclose(moved[:, 2], 0.01 * np.array(index), atol=0.06)


def test_frames_are_posed_by_the_landmarks_as_the_refinement_leaves_them(short: PointWorld) -> None:
    """The landmarks move to the side, the keyframes stay: so the frames between them move."""
    aside = np.array([0.05, 0.0, 0.0])

    def move(submap: Submap) -> None:
        submap.landmarks["xyz_mu"][:] += aside

    system = ended(short, move)
    (index, T), (_, T_as_it_was) = (main_trajectory(s) for s in (system, ended(short, lambda submap: None)))
    between = np.array([i not in system.atlas.submaps[0].keyframes for i in index])
    assert between.sum() > 15
    moved = T[:, :3, 3] - T_as_it_was[:, :3, 3]
    np.testing.assert_allclose(moved[between], np.tile(aside, (between.sum(), 1)), atol=2e-3)
    np.testing.assert_array_equal(moved[~between], 0.0)


def test_a_refinement_that_fails_leaves_the_map_as_it_was(short: PointWorld) -> None:
    def fail(submap: Submap) -> None:
        raise SolverError("no")

    indices, T = main_trajectory(ended(short, fail))
    assert_right(indices, T, short)


def test_all_frames_are_posed_and_right(plain: System, world: PointWorld) -> None:
    indices, T = main_trajectory(plain)
    assert indices == list(range(70))
    assert_right(indices, T, world)
    assert kinds(plain).count(EventKind.INITIALISED) == 1
    assert kinds(plain)[-1] is EventKind.ARCHIVED
    assert not plain.events.of_kind(EventKind.FAILED, EventKind.GRAPH_REBUILT)


def test_the_frames_before_the_start_are_posed_in_reverse() -> None:
    """The camera stands still first: the start comes late, and none of the frames before it is lost."""
    still = np.repeat(np.eye(4)[None], 15, 0)
    world = PointWorld(
        cloud(600), np.concatenate([still, path(25, np.array([0.08, 0, 0.02]), np.array([0, -0.005, 0]))])
    )
    system = system_in(world)
    results = [system.step(frame) for frame in world.frames()]
    assert all(r.status is FrameStatus.INITIALISING and r.T_submap_cam is None for r in results[:15])
    started = next(i for i, r in enumerate(results) if r.status is FrameStatus.TRACKED)
    assert started > 15
    assert all(system.rows[i].status is FrameStatus.TRACKED for i in range(40))
    indices, T = main_trajectory(system)
    assert indices == list(range(40))
    assert_right(indices, T, world)


@pytest.mark.slow
def test_a_start_that_comes_late_poses_frames_older_than_the_buffer_keeps() -> None:
    still, moving = 40, path(30, np.array([0.08, 0, 0]), np.zeros(3))
    T = np.concatenate([np.repeat(moving[:1], still, axis=0), moving])
    world = PointWorld(cloud(600), T)
    system = system_in(world, buffer={"duration_s": 0.5})
    for frame in world.frames():
        system.step(frame)
    system.finish()
    start = next(e.frame for e in system.events.of_kind(EventKind.INITIALISED))
    assert start / 30 > 0.5
    assert sorted(system.poses) == list(range(still + len(moving)))


def test_a_long_cover_before_the_start_hides_no_more_than_what_it_covers() -> None:
    still = np.repeat(np.eye(4)[None], 50, 0)
    moving = path(25, np.array([0.08, 0, 0.02]), np.array([0, -0.005, 0]))
    covered = frozenset(range(5, 45))
    assert len(covered) > RecoveryConfig().max_gap_frames
    world = PointWorld(cloud(600), np.concatenate([still, moving]), covered=covered)
    system = run(world)
    indices, T = main_trajectory(system)
    assert indices == [i for i in range(75) if i not in covered]
    assert_right(indices, T, world)


def test_the_same_seed_gives_the_same_trajectory_bit_for_bit(plain: System, world: PointWorld) -> None:
    again = run(world)
    assert np.array_equal(main_trajectory(plain)[1], main_trajectory(again)[1])
    assert [e.as_dict() for e in plain.events] == [e.as_dict() for e in again.events]


def test_results_tell_the_pose_of_the_moment(short: PointWorld) -> None:
    system = system_in(short)
    for frame in short.frames()[:30]:
        result = system.step(frame)
    assert result.T_submap_cam is not None
    assert result.n_inliers > 50
    assert result.failure is None
    assert system.live is not None
    np.testing.assert_allclose(main_trajectory(system)[1][-1], result.T_submap_cam, atol=1e-12)


def test_unreadable_frames_have_their_row_and_tracking_goes_on(world: PointWorld) -> None:
    torn = frozenset({0, 20, 21, 40})
    system = run(PointWorld(world.xyz, world.T_world_cam, unreadable=torn))
    rows = frame_rows(system, trajectories_of(system).main)
    assert [row.index for row in rows] == list(range(70))
    assert {row.index for row in rows if row.status is FrameStatus.UNREADABLE} == torn
    assert {row.index for row in rows if not row.in_main_map} == torn
    assert len(system.events.of_kind(EventKind.UNREADABLE)) == len(torn)
    assert len(system.atlas.submaps) == 1


def test_a_short_loss_is_bridged(world: PointWorld) -> None:
    gap = frozenset(range(30, 35))
    system = run(PointWorld(world.xyz, world.T_world_cam, covered=gap))
    assert len(system.atlas.submaps) == 1
    assert {i for i, row in system.rows.items() if row.status is FrameStatus.LOST} == gap
    assert not system.events.of_kind(EventKind.FAILED)
    indices, T = main_trajectory(system)
    assert_right(indices, T, world)


class ElsewhereForAWhile(PointWorld):
    """Frames 30 to `last` show another scene, of `n_elsewhere` points."""

    n_elsewhere, last = 600, 36

    def features(self, i: int) -> Features:
        elsewhere = PointWorld(cloud(self.n_elsewhere), self.T_world_cam, seed=7)
        return elsewhere.features(i) if 30 <= i <= self.last else super().features(i)


class FewThingsForAWhile(ElsewhereForAWhile):
    """As many as a blurred image shows: they are seen from frame to frame, and no map could start from them."""

    n_elsewhere = 60


class ElsewhereForAMoment(ElsewhereForAWhile):
    """In so few frames that a map of them would not know its scale, and could not be joined."""

    last = 34


@pytest.mark.parametrize(
    ("shows", "is_blank"), [(ElsewhereForAWhile, False), (FewThingsForAWhile, True), (ElsewhereForAMoment, True)]
)
def test_a_lost_frame_could_not_be_posed_if_nothing_leads_from_it_to_a_map(
    world: PointWorld, shows: type[ElsewhereForAWhile], is_blank: bool
) -> None:
    elsewhere = set(range(30, shows.last + 1))
    covered = run(PointWorld(world.xyz, world.T_world_cam[:40], covered=frozenset(elsewhere)))
    assert covered.blank == elsewhere
    system = run(shows(world.xyz, world.T_world_cam[:40]))
    assert {i for i, row in system.rows.items() if row.status is FrameStatus.LOST} == elsewhere
    assert system.blank == (elsewhere if is_blank else set())


@pytest.mark.parametrize("max_lost_s", [0.125, 0.225])
def test_how_long_a_loss_may_be_is_told_in_seconds(world: PointWorld, max_lost_s: float) -> None:
    covered = PointWorld(world.xyz, world.T_world_cam[:46], covered=frozenset(range(35, 46)))
    system = run(covered, tracking={"max_lost_s": max_lost_s})
    (failed,) = system.events.of_kind(EventKind.FAILED)
    assert failed.frame == 35 + int(np.ceil(max_lost_s * RATE_HZ))


def test_a_slow_camera_has_frames_to_be_found_again_in(world: PointWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dualslam.testing.point_world.RATE_HZ", 1.0)
    covered = PointWorld(world.xyz, world.T_world_cam[:46], covered=frozenset(range(35, 46)))
    system = run(covered, tracking={"max_lost_s": 1.2})
    (failed,) = system.events.of_kind(EventKind.FAILED)
    assert failed.frame == 35 + 6  # by its clock with the third frame; 5 Hz gives six in 1.2 s


def test_a_map_that_is_seen_again_in_time_goes_on(world: PointWorld) -> None:
    covered = PointWorld(world.xyz, world.T_world_cam, covered=frozenset(range(35, 50)))
    system = run(covered, tracking={"max_lost_s": 1.0})
    assert not system.events.of_kind(EventKind.FAILED)
    (again,) = system.events.of_kind(EventKind.GAP_RELOCALISED)
    assert again.frame == 50
    assert_right(*main_trajectory(system), world)


@pytest.mark.parametrize("is_firm", [True, False])
def test_a_map_that_starts_meanwhile_ends_the_wait(is_firm: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """From one frame to the next the camera looks the other way, and goes on. Only a firm start may come early."""
    monkeypatch.setattr("dualslam.system.starting.FIRM_SIGMA_DEG", np.inf if is_firm else 0.0)
    before, after = path(20, np.array([0.08, 0, 0]), np.zeros(3)), path(20, np.array([0.08, 0, 0.02]), np.zeros(3))
    turned = path(2, np.zeros(3), np.array([0, np.pi, 0]))[1]
    both_sides = np.concatenate([cloud(600), cloud(600, seed=1) * (1, 1, -1)])
    world = PointWorld(both_sides, np.concatenate([before, turned @ after]))
    system = run(world, tracking={"max_lost_s": 1.0})
    (failed,) = system.events.of_kind(EventKind.FAILED)
    (started,) = system.events.of_kind(EventKind.REINITIALISED)
    assert failed.frame == started.frame < 20 + 1.0 * RATE_HZ
    assert (started.frame < 20 + EARLY_FRAMES) == is_firm
    assert {i: row.submap for i, row in system.rows.items()} == {i: int(i >= 20) for i in range(40)}


def test_frames_since_a_loss_wait_for_the_next_map_however_short_the_buffer() -> None:
    """After the loss the camera stands still, elsewhere: no map can start, and no frame may be forgotten meanwhile."""
    before, after = path(20, np.array([0.08, 0, 0]), np.zeros(3)), path(15, np.array([0.08, 0, 0.02]), np.zeros(3))
    still = np.repeat(after[:1], 25, 0)
    turned = path(2, np.zeros(3), np.array([0, np.pi, 0]))[1]
    T = np.concatenate([before, turned @ still, turned @ after])
    both_sides = np.concatenate([cloud(600), cloud(600, seed=1) * (1, 1, -1)])
    system = run(PointWorld(both_sides, T), buffer={"duration_s": 0.3})
    assert len(system.atlas.submaps) == 2
    assert {i: row.submap for i, row in system.rows.items()} == {i: int(i >= 20) for i in range(60)}


def turning_back(n_away: int) -> PointWorld:
    """A walk that slows down, a turn in place to where no map can start, as long as it lasts, and back to walk on."""
    walk = path(45, np.array([0.08, 0, 0]), np.zeros(3))
    # Had it stopped unseen and gone on at the same speed, its motion would contradict it.
    walk[:, 0, 3] = np.cumsum(0.08 * np.minimum(np.abs(np.arange(45) - 24.5) / 10, 1.0))
    away = walk[24] @ path(2, np.zeros(3), np.array([0, np.pi, 0]))[1]
    behind = cloud(600, seed=1) * (1, 1, -1) + walk[24][:3, 3]
    T = np.concatenate([walk[:25], np.repeat(away[None], n_away, 0), walk[25:]])
    return PointWorld(np.concatenate([cloud(600), behind]), T)


def test_a_lost_map_that_is_seen_again_before_another_starts_is_gone_on_with() -> None:
    world = turning_back(25)
    system = run(world, recovery={"enabled": True})
    (relocalised,) = system.events.of_kind(EventKind.RELOCALISED)
    assert relocalised.frame == 25 + 25 + 2, "three frames must show it"
    assert len(system.atlas.submaps) == 1
    assert [k for k in kinds(system) if k in (EventKind.FAILED, EventKind.REINITIALISED)] == [EventKind.FAILED]
    indices, T = main_trajectory(system)
    assert [i for i in range(70) if i not in indices] == list(range(25, 50)), "the first frame is tracked back to"
    assert system._state.record.observations.keys() >= {50, 51, 52}, "frames that confirm the place can be posed again"
    assert_right(indices[5:], T[5:], world)
    assert system.rows[69].status is FrameStatus.TRACKED


def test_a_new_map_has_its_chance_after_each_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lost, seen again, and lost once more: only after so many frames anew is it asked which submap shows them."""
    asked, sighted = [], Sightings.sighted

    def watched(self: Sightings, view: View, K: FloatArray) -> Relocalised | None:
        asked.append(view.index)
        return sighted(self, view, K)

    monkeypatch.setattr(Sightings, "sighted", watched)
    once, T = turning_back(25), turning_back(25).T_world_cam
    system = run(PointWorld(once.xyz, np.concatenate([T, np.repeat(T[30:31], 12, 0)])), recovery={"enabled": True})
    first, second = (event.frame for event in system.events.of_kind(EventKind.FAILED))
    assert second > len(T)
    assert min(asked) == first + 16
    assert max(asked) < len(T)
    assert kinds(system).count(EventKind.RELOCALISED) == 1
    losses = breakages(tuple(system.events))
    assert [(loss.submap, loss.relocalised, loss.recovered) for loss in losses] == [(0, True, True), (0, False, False)]


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{"enabled": False}, {"enabled": True, "relocalise_after": None}])
def test_it_is_not_looked_for_where_that_is_not_wanted(settings: dict[str, object]) -> None:
    system = run(turning_back(25), recovery=settings)
    assert not system.events.of_kind(EventKind.RELOCALISED)
    assert len(system.atlas.submaps) == 2


def test_a_map_that_starts_at_once_comes_first() -> None:
    system = run(turning_back(25), recovery={"enabled": True, "relocalise_after": 40})
    assert not system.events.of_kind(EventKind.RELOCALISED)
    assert system.events.of_kind(EventKind.REINITIALISED)


@pytest.fixture(scope="module")
def parted(world: PointWorld) -> System:
    return run(PointWorld(world.xyz, world.T_world_cam, covered=frozenset(range(35, 50))))


def test_a_long_loss_ends_the_submap_and_the_next_one_starts(parted: System, world: PointWorld) -> None:
    assert len(parted.atlas.submaps) == 2
    order = [k for k in kinds(parted) if k not in (EventKind.INITIALISATION_REFUSED, EventKind.GAP_RELOCALISED)]
    assert order == [
        EventKind.INITIALISED,
        EventKind.FAILED,
        EventKind.ARCHIVED,
        EventKind.REINITIALISED,
        EventKind.ARCHIVED,
    ]
    (failed,) = parted.events.of_kind(EventKind.FAILED)
    assert failed.data["lost_since"] == 35
    assert failed.frame == 35 + 8
    found = trajectories_of(parted)
    assert found.main_submaps == [0]
    assert found.main.index.tolist() == list(range(35))
    assert found.unlinked[1].index.tolist() == list(range(50, 70))
    for posed in (found.main, found.unlinked[1]):
        assert_right(posed.index.tolist(), posed.T_world_cam, world)


def test_every_frame_of_a_parted_run_has_its_row(parted: System) -> None:
    rows = frame_rows(parted, trajectories_of(parted).main)
    assert [row.index for row in rows] == list(range(70))
    for row in rows:
        assert row.in_main_map == (row.index < 35)
        if 35 <= row.index < 50:
            assert row.submap is None
            assert row.status in (FrameStatus.LOST, FrameStatus.INITIALISING)
        else:
            assert row.status is FrameStatus.TRACKED
            assert row.submap == int(row.index >= 50)


def test_the_main_map_is_the_one_with_most_frames(world: PointWorld) -> None:
    system = run(PointWorld(world.xyz, world.T_world_cam, covered=frozenset(range(18, 32))))
    found = trajectories_of(system)
    assert found.main_submaps == [1]
    assert found.main.index.tolist() == list(range(32, 70))
    assert list(found.unlinked) == [0]


@pytest.mark.parametrize("fails", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_rolling_over_loses_nothing(world: PointWorld, monkeypatch: pytest.MonkeyPatch, fails: bool) -> None:
    settings = {
        "graph": {"max_keyframes": 20, "rollover_keyframes": 6},
        "keyframes": {"max_parallax_deg": 1.0},
        "mapping": {"redundant_ratio": 1.0},
        "loops": {"enabled": False},
    }
    if fails:
        monkeypatch.setattr(GtsamAtlasSolver, "solve", no_solution)
    system = run(world, **settings)
    assert len(system.atlas.submaps) > 1
    assert not system.events.of_kind(EventKind.FAILED)
    assert len(system.events.of_kind(EventKind.ROLLED_OVER)) == len(system.atlas.links)
    found = trajectories_of(system)
    assert found.main_submaps == sorted(system.atlas.submaps)
    assert not found.unlinked
    assert found.main.index.tolist() == list(range(70))
    assert_right(found.main.index.tolist(), found.main.T_world_cam, world)


def no_solution(solver: GtsamAtlasSolver, problem: AtlasProblem) -> AtlasSolution:
    raise SolverError("no")


def test_frames_may_come_in_reverse(world: PointWorld) -> None:
    system = system_in(world)
    for frame in reversed(world.frames()):
        system.step(frame)
    system.finish()
    indices, T = main_trajectory(system)
    assert indices == list(range(70))
    assert_right(indices, T, world)
    assert [row.index for row in frame_rows(system, trajectories_of(system).main)] == list(range(69, -1, -1))


def test_nothing_to_see_gives_no_map() -> None:
    world = PointWorld(cloud(600), hand_held(12), covered=frozenset(range(12)))
    system = run(world)
    assert not system.atlas.submaps
    assert all(row.status is FrameStatus.INITIALISING for row in system.rows.values())
    found = trajectories_of(system)
    assert len(found.main) == 0
    assert found.main_submaps == []


def test_cpu_times_of_the_stages_are_kept(plain: System) -> None:
    stages = plain.timer.stages
    assert {"features", "initialisation", "tracking", "mapping", "graph (in mapping)"} <= set(stages)
    assert stages["graph (in mapping)"].seconds <= stages["mapping"].seconds


def test_a_pose_is_told_before_the_map_grows_from_it() -> None:
    world = PointWorld(cloud(600), hand_held(30))
    system = system_in(world)
    told: dict[int, bool] = {}

    def on_pose(track: Track) -> None:
        told[track.view.index] = system.live is not None and track.view.index in system.live.submap.keyframes

    system.on_pose = on_pose
    results = [system.step(frame) for frame in world.frames()]
    assert not any(told.values())
    assert set(told) & set(system.atlas.submaps[0].keyframes)  # some of them became keyframes
    for result in results:
        assert (result.pose_ms is not None) == (result.index in told)
        assert result.pose_ms is None or 0 < result.pose_ms <= result.latency_ms
