"""Frames without a pose when a map starts: tried again once it has grown, from either side; right, or not at all."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dualslam.atlas.trajectory import FramePose
from dualslam.build import recovery_parts
from dualslam.core.config.settings import Config
from dualslam.core.geometry import se3, so3
from dualslam.core.types import FloatArray, FrameStatus, Keyframe, View
from dualslam.frontends.tracking.local_map import covering_keyframes
from dualslam.map.submap import Submap
from dualslam.recovery.job import RecoveryResult
from dualslam.recovery.reverse_tracking import run_recovery
from dualslam.recovery.schedule import RetrySchedule, as_far_as_it_leads, way_to_gaps
from dualslam.run.results import trajectories_of
from dualslam.system.system import System
from dualslam.testing.point_world import (
    CAMERA,
    PointWorld,
    cloud,
    hand_held,
    pose_errors,
    random_features,
    system_in,
)
from dualslam.testing.walks import WatchedWalks, replace_walks
from tests.recovery.test_late_merge import LateExecutor

POSITION_M, ROTATION_RAD = 0.1, 0.01  # over a way of 5 m, with a turn of 120 degrees
N_BEHIND, N_SWEEP = 12, 60
AWAY_RAD = np.radians(120.0)  # the camera's view is 71 degrees wide


def ring(n: int = 2000) -> FloatArray:
    """Points on all sides."""
    rng = np.random.default_rng([0, 4])
    azimuth, radius = rng.uniform(0, 2 * np.pi, n), rng.uniform(5, 12, n)
    return np.column_stack([radius * np.sin(azimuth), rng.uniform(-5, 5, n), radius * np.cos(azimuth)])


def sweep(n: int, to_rad: float, first: int = 10, last: int = 45) -> FloatArray:
    """A camera that goes on its way and turns to the left meanwhile, between two frames."""
    i = np.arange(n)
    turn = to_rad * np.clip((i - first) / (last - first), 0, 1)
    return se3.from_parts(
        so3.exp(np.column_stack([0 * turn, -turn, 0 * turn])),
        np.column_stack([0.06 * i, 0.3 * np.sin(0.2 * i), 0.03 * i]),
    )


def away_first(covered: frozenset[int] = frozenset()) -> PointWorld:
    """The camera stands and looks aside, turns at once to where a map starts, and comes by what it saw first."""
    aside = se3.from_parts(so3.exp(np.array([0.0, -AWAY_RAD, 0.0])), np.zeros(3))
    T_world_cam = np.concatenate([np.repeat(aside[None], N_BEHIND, 0), sweep(N_SWEEP, AWAY_RAD)])
    return PointWorld(ring(), T_world_cam, covered=covered)


def watched_system(world: PointWorld, polls: int = 0, **recovery: object) -> tuple[System, WatchedWalks]:
    system = system_in(world, recovery=recovery)
    watched = replace_walks(system, lambda inner: WatchedWalks(LateExecutor(inner, polls) if polls else inner))
    return system, watched


@cache
def stepped(retry_keyframes: tuple[int, ...]) -> tuple[System, WatchedWalks]:
    """A run of `away_first` before its end; tests look at it and leave it as it is."""
    world = away_first()
    system, watched = watched_system(world, retry_keyframes=list(retry_keyframes))
    for frame in world.frames():
        system.step(frame)
    return system, watched


def assert_right(system: System, world: PointWorld, expected: Iterable[int]) -> None:
    main = trajectories_of(system).main
    assert main.index.tolist() == sorted(expected)
    translation, rotation = pose_errors(main.T_world_cam, world.T_world_cam[main.index])
    assert translation.max() < POSITION_M
    assert rotation.max() < ROTATION_RAD


class TestFramesBeforeTheStart:
    @pytest.mark.parametrize(("enabled", "polls"), [(False, 0), (True, 0), (True, 6)])
    def test_they_are_posed_once_the_map_shows_what_they_saw(self, enabled: bool, polls: int) -> None:
        world = away_first()
        # By its ninth keyframe the map shows what the first frames saw, whichever frames became keyframes.
        system, watched = watched_system(world, polls, enabled=enabled, retry_keyframes=[9])
        for frame in world.frames():
            system.step(frame)
            if len(watched.jobs) < 2:
                assert all(system.rows[i].status is FrameStatus.INITIALISING for i in range(min(N_BEHIND, frame.index)))
        system.finish()
        assert_right(system, world, range(N_BEHIND + N_SWEEP))
        first, again = watched.jobs
        assert [view.index for view in first.views] == list(reversed(range(first.newest_id)))
        # Made again, the walk goes over what is missing, from the keyframe next to it.
        assert [view.index for view in again.views] == list(reversed(range(N_BEHIND)))
        assert again.newest_id == N_BEHIND
        assert not again.lost

    @pytest.mark.slow
    def test_the_same_in_a_sequence_that_is_read_backwards(self) -> None:
        forwards = away_first()
        world = PointWorld(forwards.xyz, forwards.T_world_cam[::-1])
        system, watched = watched_system(world, enabled=False, retry_keyframes=[9])
        for frame in reversed(world.frames()):
            system.step(frame)
        system.finish()
        assert len(watched.jobs) == 2
        assert_right(system, world, range(N_BEHIND + N_SWEEP))

    @pytest.mark.slow
    def test_poses_that_were_there_stay_but_for_what_the_graph_moves(self) -> None:
        """They keep their keyframe, or a neighbour of it, and the map's shape."""
        alone, first = stepped(())
        helped, watched = stepped((8,))
        assert (len(first.jobs), len(watched.jobs)) == (1, 2)
        a, b = (trajectories_of(system).main for system in (alone, helped))
        assert b.index.tolist()[N_BEHIND:] == a.index.tolist()
        translation, rotation = pose_errors(b.T_world_cam[N_BEHIND:], a.T_world_cam)
        assert translation.max() < POSITION_M
        assert rotation.max() < ROTATION_RAD

    def test_what_shows_nothing_stays_without_a_pose_and_is_not_tried_for_ever(self) -> None:
        world = away_first(covered=frozenset(range(N_BEHIND)))
        system, watched = watched_system(world, retry_keyframes=[3, 5, 7])
        for frame in world.frames():
            system.step(frame)
        system.finish()
        assert len(watched.jobs) == 2
        assert system.timer.stages["merging"].calls == 1  # the second one leaves the map as it is
        assert all(system.rows[i].status is FrameStatus.INITIALISING for i in range(N_BEHIND))
        assert_right(system, world, range(N_BEHIND, N_BEHIND + N_SWEEP))

    def test_a_map_that_stays_small_tracks_in_reverse_once_more_at_the_end_of_the_run(self) -> None:
        world = away_first()
        system, watched = watched_system(world, retry_keyframes=[1000])
        for frame in world.frames():
            system.step(frame)
        assert len(watched.jobs) == 1
        system.finish()
        assert [view.index for view in watched.jobs[1].views] == list(reversed(range(N_BEHIND)))
        assert_right(system, world, range(N_BEHIND + N_SWEEP))

    def test_it_does_not_where_someone_waits_for_the_end(self) -> None:
        world = away_first()
        system, watched = watched_system(world, retry_keyframes=[1000])
        for frame in world.frames():
            system.step(frame)
        system.finish(interrupted=True)
        assert len(watched.jobs) == 1
        assert_right(system, world, range(N_BEHIND, N_BEHIND + N_SWEEP))

    def test_nothing_is_tried_again_where_all_frames_have_a_pose(self) -> None:
        world = PointWorld(cloud(600), hand_held(50))
        system, watched = watched_system(world, retry_keyframes=[2, 3, 4, 5, 6])
        for frame in world.frames():
            system.step(frame)
        assert len(watched.jobs) == 1

    @pytest.mark.slow
    def test_the_same_seed_gives_the_same_poses_bit_for_bit(self) -> None:
        first, again = (trajectories_of(run((8,))[0]).main for run in (stepped, stepped.__wrapped__))
        assert np.array_equal(first.T_world_cam, again.T_world_cam)


def test_what_is_lost_on_the_way_back_is_found_on_the_way_there() -> None:
    """The camera turns away bit by bit, and back at once, and there a map starts: as if none could have before."""
    n_away = 50
    world = PointWorld(ring(), np.concatenate([sweep(n_away, AWAY_RAD, first=0), sweep(12, 0.0)]))
    system, watched = watched_system(world)
    for frame in world.frames()[n_away:]:
        system.step(frame)
    (job,) = watched.jobs
    job = replace(job, views=(*job.views, *(world.view(i) for i in reversed(range(n_away)))))
    result = run_recovery(job, recovery_parts(Config(), CAMERA))
    assert isinstance(result, RecoveryResult)
    order = [frame.pose.index for frame in result.frames]
    assert sorted(order)[:n_away] == list(range(n_away))
    assert len(order) == len(set(order))
    back, there = order[: order.index(0) + 1], order[order.index(0) + 1 :]
    assert back == sorted(back, reverse=True)
    assert there == sorted(there)
    assert there[-1] == n_away - 1
    assert len(there) > 10
    poses = sorted((frame.pose for frame in result.frames), key=lambda pose: pose.index)
    T = np.stack([result.submap.resolve_anchor(pose.keyframe_id, pose.T_kf_cam) for pose in poses])
    translation, rotation = pose_errors(T, world.T_world_cam[[pose.index for pose in poses]])
    assert translation.max() < POSITION_M
    assert rotation.max() < ROTATION_RAD


def views(indices: Iterable[int]) -> list[View]:
    features = random_features(np.random.default_rng(0), 1)
    return [View(i, float(i), features) for i in indices]


class TestWayToGaps:
    @pytest.mark.parametrize(
        ("without_pose", "keyframes", "way"),
        [
            ([], [9, 5, 0], []),
            ([3], [9, 5, 0], [5, 4, 3]),
            ([0, 1], [9, 5, 4, 3], [3, 2, 1, 0]),
            ([0, 7], [9, 8, 5, 3], [8, 7, 5, 3, 1, 0]),
            ([9, 8], [7, 1], []),  # nothing leads there from this side
            ([9, 4], [7, 5, 1], [5, 4]),
            ([4, 3], [9, 4], [4, 3]),  # a keyframe has its pose in the map
            ([4], [], []),
        ],
    )
    def test_it_leads_from_a_keyframe_to_what_has_no_pose(
        self, without_pose: list[int], keyframes: list[int], way: list[int]
    ) -> None:
        order = list(range(9, -1, -1))
        posed = set(order) - set(without_pose)
        assert [view.index for view in way_to_gaps(views(order), posed, keyframes)] == way

    @pytest.mark.parametrize(
        ("posed_in", "keyframes", "last"),
        [
            ({9: 0, 7: 0, 5: 0, 3: 0}, [9, 5], 0),  # its own
            ({9: 0, 6: 1, 5: 1, 3: 1}, [9, 4], 4),  # linked, and older than all that it knows
            ({9: 0, 6: 1, 5: 1, 3: 1}, [9, 6, 3], 0),
            ({9: 0, 6: 2, 5: 2}, [9, 4], 7),  # of a map that is not linked
        ],
    )
    def test_it_leads_over_no_stretch_that_is_only_another_map_s(
        self, posed_in: dict[int, int], keyframes: list[int], last: int
    ) -> None:
        poses = {i: FramePose(i, float(i), m, i, np.eye(4)) for i, m in posed_in.items()}
        order = views(range(9, -1, -1))
        way = [view.index for view in as_far_as_it_leads(order, poses, submap_with(keyframes), {0, 1})]
        assert way == list(range(9, last - 1, -1))


def submap_with(keyframes: Iterable[int]) -> Submap:
    submap = Submap(0, CAMERA.K, np.zeros(32, np.uint8))
    features = random_features(np.random.default_rng(0), 1)
    for k in keyframes:
        submap.add_keyframe(Keyframe(k, float(k), features), np.eye(4))
    return submap


class TestSchedule:
    def test_a_walk_is_due_at_each_size_once_and_only_where_something_is_left(self) -> None:
        schedule = RetrySchedule((3, 5))
        due = []
        for now in range(10, 20):
            submap = submap_with([2, 4, *range(10, now + 1)])  # 2 and 4 came by the first walk
            assert schedule.start_of(submap, now) == 10
            if now == 10:
                assert not schedule.take_if_due(submap, now, CAMERA)
                schedule.leave_open(0, schedule.n_live(submap, now), CAMERA)
            if schedule.take_if_due(submap, now, CAMERA):
                due.append(now)
                assert not schedule.take_if_due(submap, now, CAMERA)
                schedule.leave_open(0, schedule.n_live(submap, now), CAMERA)
        assert due == [12, 14]

    @pytest.mark.parametrize(
        ("keyframes", "n_tried", "n_new", "due"),
        [((100,), 2, 1, True), ((100,), 2, 0, False), ((), 2, 1, False), ((100,), 6, 2, False), ((100,), 6, 3, True)],
    )
    def test_the_last_walk_wants_a_map_that_has_grown_by_half(
        self, keyframes: tuple[int, ...], n_tried: int, n_new: int, due: bool
    ) -> None:
        schedule = RetrySchedule(keyframes)
        assert schedule.start_of(submap_with(range(10, 10 + n_tried)), 10) == 10
        schedule.leave_open(0, n_tried, CAMERA)
        grown = submap_with(range(10, 10 + n_tried + n_new))
        assert not schedule.take_if_due(grown, 20, CAMERA)
        assert schedule.take_if_due(grown, 20, CAMERA, last_chance=True) == due

    def test_keyframes_are_counted_from_the_start_to_now(self) -> None:
        schedule = RetrySchedule((3,))
        submap = submap_with([8, 9, 10, 14, 17])
        schedule.start_of(submap, 10)
        assert schedule.n_live(submap, 14) == 2
        assert schedule.n_live(submap, 17) == 3

    @pytest.mark.parametrize(("stopped_at", "due"), [((7, 7), False), ((7, 6), True), ((None, None), True)])
    def test_walks_that_stop_at_one_frame_twice_are_made_again_for_another_camera_alone(
        self, stopped_at: tuple[int | None, int | None], due: bool
    ) -> None:
        schedule = RetrySchedule((3, 5))
        grown = submap_with(range(10, 20))
        schedule.start_of(grown, 10)
        schedule.leave_open(0, 2, CAMERA, stopped_at=stopped_at[0])
        assert schedule.take_if_due(grown, 12, CAMERA)
        for last_chance in (False, True):
            schedule.leave_open(0, 3, CAMERA, stopped_at=stopped_at[0])
            schedule.leave_open(0, 3, CAMERA, stopped_at=stopped_at[1])
            assert schedule.take_if_due(grown, 19, CAMERA, last_chance) == due
        schedule.leave_open(0, 3, CAMERA, stopped_at=stopped_at[1])
        assert schedule.take_if_due(grown, 19, replace(CAMERA, fx=451.0))

    def test_another_camera_is_a_reason(self) -> None:
        schedule = RetrySchedule(())
        submap = submap_with([10, 11])
        schedule.start_of(submap, 10)
        schedule.leave_open(0, 1, CAMERA)
        assert not schedule.take_if_due(submap, 11, CAMERA)
        assert schedule.take_if_due(submap, 11, replace(CAMERA, fx=451.0))

    def test_a_camera_that_is_contradicted_must_change_or_the_run_end(self) -> None:
        schedule = RetrySchedule((3, 5))
        schedule.start_of(submap_with([10, 11]), 10)
        grown = submap_with(range(10, 16))
        schedule.leave_open(0, 2, CAMERA, needs_camera=True)
        assert not schedule.take_if_due(grown, 15, CAMERA)
        assert schedule.take_if_due(grown, 15, replace(CAMERA, fx=451.0))
        schedule.leave_open(0, 2, CAMERA, needs_camera=True)
        assert schedule.take_if_due(grown, 15, CAMERA, last_chance=True)


@pytest.mark.slow
def test_a_walk_reads_no_frame_that_is_older_than_the_lost_map() -> None:
    """The lost map has rolled over: older frames are another's, and no link can come of them."""
    covered = frozenset(range(100, 115))
    world = PointWorld(cloud(600), hand_held(130), covered=covered)
    settings = {
        "recovery": {"attempts": ["live"]},
        "graph": {"max_keyframes": 20, "rollover_keyframes": 6},
        "keyframes": {"max_parallax_deg": 1.0},
        "mapping": {"redundant_ratio": 1.0},
    }
    system = system_in(world, **settings)
    watched = replace_walks(system, WatchedWalks)
    for frame in world.frames():
        system.step(frame)
    job = next(job for job in watched.jobs if job.lost)
    ((lost_id, lost),) = job.lost.items()
    assert lost_id > 0
    assert 0 < job.views[-1].index <= min(lost.keyframes)
    assert system.atlas.components() == [list(range(len(system.atlas.submaps)))]
    older = [p.index for p in system.poses.values() if p.submap_id < lost_id]
    assert max(older) >= job.views[-1].index - 1  # what comes before has its place in another map


def test_few_keyframes_cover_the_map() -> None:
    system, _ = stepped((8,))
    assert system.live is not None
    submap = system.live.submap
    seen = {k: set(ids[ids >= 0].tolist()) for k, ids in submap.landmark_of.items()}
    chosen = covering_keyframes(submap, at_most=20, min_new=20)
    assert 2 <= len(chosen) < len(submap.keyframes)
    covered: set[int] = set()
    for k in chosen:
        gains = {other: len(seen[other] - covered) for other in seen}
        assert gains[k] == max(gains.values()) >= 20
        covered |= seen[k]
    assert max(len(ids - covered) for ids in seen.values()) < 20
    assert covering_keyframes(submap, at_most=1, min_new=20) == chosen[:1]
