"""A submap's graph in another process: it follows the arrays by deltas, and an answer that is late is as good."""

from __future__ import annotations

import os
import pickle
import signal
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from dualslam.backend.submap_graph import ISam2SubmapGraph
from dualslam.build import build_system, window_solver
from dualslam.build.parts import graph_maker
from dualslam.core.config.settings import Config
from dualslam.core.errors import SolverError
from dualslam.core.estimates import GraphEstimate
from dualslam.core.jobs import InlineDesk, JobKind
from dualslam.core.types import Failure, FailureReason, FrameStatus
from dualslam.map.graph_beside import BesideGraph, BesideGraphs, GraphJob, GraphServer
from dualslam.map.lens import change_camera
from dualslam.map.submap import Submap
from dualslam.map.submap_change import open_graph
from dualslam.map.submap_delta import SubmapMirror
from dualslam.run.results import trajectories_of
from dualslam.system.system import System
from dualslam.testing.graph_scene import guessed_submap, make_scene
from dualslam.testing.graph_scene import pose_errors as scene_errors
from dualslam.testing.late_desk import LateDesk
from dualslam.testing.point_world import CAMERA, PointWorld, cloud, hand_held, pose_errors, system_in
from dualslam.workers.desk import WorkerDesk
from tests.backend.test_self_calibration import wrong_camera
from tests.map.test_submap import assert_consistent

DENSE = {"keyframes": {"max_parallax_deg": 2.0}}
POSITION_M, ROTATION_RAD = 0.08, 0.01


def assert_follows(replica: Submap, submap: Submap) -> None:
    """Assert that a replica holds what a graph looks at."""
    assert set(replica.keyframes) == set(submap.keyframes)
    assert replica.gauge == submap.gauge
    np.testing.assert_array_equal(replica.K, submap.K)
    for name in ("kf", "feature", "landmark", "alive"):
        np.testing.assert_array_equal(replica.observations[name], submap.observations[name])
    np.testing.assert_array_equal(replica.landmarks["alive"], submap.landmarks["alive"])
    for k, keyframe in submap.keyframes.items():
        np.testing.assert_array_equal(replica.landmark_of[k], submap.landmark_of[k])
        np.testing.assert_array_equal(replica.keyframes[k].features.uv_rect_px, keyframe.features.uv_rect_px)
    assert replica.relative_poses.keys() == submap.relative_poses.keys()
    assert set(replica.anchors) <= set(submap.anchors)


def test_a_replica_follows_a_map_that_grows_and_is_culled() -> None:
    world = PointWorld(cloud(), hand_held(60))
    system, mirror, replica = system_in(world, **DENSE), SubmapMirror(), None
    sizes = []
    for frame in world.frames():
        system.step(frame)
        if frame.index % 3 == 0 and system.live is not None:
            sent = pickle.dumps(mirror.delta(system.live.submap))
            sizes.append(len(sent))
            replica = pickle.loads(sent).apply(replica)
            assert_follows(replica, system.live.submap)
    submap = system.atlas.submaps[0]
    assert submap.anchors
    replica = mirror.delta(submap).apply(replica)
    for k in list(submap.keyframes)[-5:]:
        np.testing.assert_array_equal(replica.T_submap_kf[k], submap.T_submap_kf[k])
    whole = len(pickle.dumps(SubmapMirror().delta(submap)))
    assert np.median(sizes) < 0.5 * whole


def test_with_another_camera_a_replica_is_made_anew() -> None:
    world = PointWorld(cloud(), hand_held(25))
    submap, mirror = run(system_in(world), world).atlas.submaps[0], SubmapMirror()
    replica = mirror.delta(submap).apply(None)
    assert not mirror.delta(submap).is_whole
    change_camera(submap, wrong_camera(1.05))
    again = mirror.delta(submap)
    assert again.is_whole
    assert_follows(again.apply(replica), submap)


def new_isam2() -> ISam2SubmapGraph:
    return ISam2SubmapGraph(Config().graph)


def no_window(submap: Submap, keyframe_ids: list[int]) -> Failure:
    return Failure(FailureReason.SOLVER, "no window")


def beside(world: PointWorld, polls: int, **settings: object) -> System:
    """A system whose graphs are solved inline, but come back late, by way of a delta as to another process."""
    system = system_in(world, **settings)
    desk = LateDesk(InlineDesk({JobKind.GRAPH: GraphServer(graph_maker(system._state.config))}), polls)
    graphs = BesideGraphs(desk, window_solver(system._state.config), partial(open_graph, new_graph=new_isam2))
    system._state.parts = replace(system._state.parts, new_graph=graphs.new_graph, graphs=graphs)
    system._recoveries._new_graph = graphs.new_graph
    system._calibrations._new_graph = graphs.new_graph
    return system


def run(system: System, world: PointWorld) -> System:
    for frame in world.frames():
        system.step(frame)
    system.finish()
    return system


@pytest.fixture(scope="module")
def world() -> PointWorld:
    return PointWorld(cloud(), hand_held(70))


def assert_right(system: System, world: PointWorld) -> None:
    """Assert that every frame is where it was: within what merges that come late are allowed (`test_late_merge.py`)."""
    main = trajectories_of(system).main
    assert set(main.index.tolist()) == set(range(len(world.T_world_cam))) - world.covered
    translation, rotation = pose_errors(main.T_world_cam, world.T_world_cam[main.index])
    assert translation.max() < POSITION_M
    assert rotation.max() < ROTATION_RAD


@pytest.mark.parametrize("polls", [pytest.param(1, marks=pytest.mark.slow), 6])
def test_a_graph_that_answers_late_is_as_good_as_one_in_time(world: PointWorld, polls: int) -> None:
    system = run(beside(world, polls, **DENSE), world)
    assert isinstance(system.live and system.live.graph, BesideGraph)
    assert all(row.status is FrameStatus.TRACKED for row in list(system.rows.values())[5:])
    assert_right(system, world)
    assert_consistent(system.atlas.submaps[0])
    graphs = system._state.parts.graphs
    assert graphs is not None
    assert graphs.lag(system.atlas.submaps[0]) == 0


@pytest.mark.slow
def test_two_maps_are_linked_whose_graphs_answer_late() -> None:
    world = PointWorld(cloud(), hand_held(90), covered=frozenset(range(35, 50)))
    system = run(beside(world, 2, recovery={"enabled": True}), world)
    assert_right(system, world)


def test_a_server_that_does_not_know_a_graph_says_so() -> None:
    world = PointWorld(cloud(), hand_held(20))
    system = run(system_in(world), world)
    mirror = SubmapMirror()
    first, second = (mirror.delta(system.atlas.submaps[0]) for _ in range(2))
    server = GraphServer(lambda: ISam2SubmapGraph(Config().graph))
    lost = server(GraphJob(7, second, False, False))
    assert not lost
    assert lost.reason is FailureReason.DISABLED  # type: ignore[union-attr]
    assert server(GraphJob(7, first, False, False))
    assert server(GraphJob(7, second, False, False))


@pytest.mark.parametrize("reason", [FailureReason.DISABLED, FailureReason.SOLVER, FailureReason.TIMEOUT])
def test_a_graph_that_fails_at_the_end_keeps_no_other_from_being_solved(reason: FailureReason) -> None:
    """The newer submap's job fails; then a merge changes the older one, which the end asks for once more."""
    server, failing = GraphServer(lambda: ISam2SubmapGraph(Config().graph)), {1}
    scenes = [make_scene(6, noise_px=0.5, seed=m) for m in range(2)]

    def solve(job: GraphJob) -> GraphEstimate | Failure:
        return Failure(reason, "as it was told") if job.graph_id in failing else server(job)

    graphs = BesideGraphs(InlineDesk({JobKind.GRAPH: solve}), no_window, partial(open_graph, new_graph=new_isam2))
    submaps = {m: guessed_submap(scene, pose_noise=0.02) for m, scene in enumerate(scenes)}
    for m, submap in submaps.items():
        submap.id = m
        graphs.new_graph().update(submap)
    moved = [each.submap.id for each in graphs.finish(submaps)]
    assert moved[:1] == ([] if reason is FailureReason.TIMEOUT else [0])  # a process that hangs is not asked again
    graphs.new_graph().rebuild(submaps[0])
    failing.clear()
    moved = [each.submap.id for each in graphs.finish(submaps)]
    assert 0 in moved
    assert graphs.lag(submaps[0]) == 0
    translation, _ = scene_errors(submaps[0].keyframe_poses(range(6)), scenes[0].T_true)
    assert translation.max() < 0.01


def test_what_a_graph_was_solving_when_its_submap_was_bent_straightens_nothing() -> None:
    desk = LateDesk(InlineDesk({JobKind.GRAPH: GraphServer(lambda: ISam2SubmapGraph(Config().graph))}), 1)
    graphs = BesideGraphs(desk, no_window, partial(open_graph, new_graph=new_isam2))
    submap = guessed_submap(make_scene(6, noise_px=0.5), pose_noise=0.02)
    graphs.new_graph().update(submap)
    assert not list(graphs.collect({submap.id: submap}))
    submap.transform(1.5, np.eye(4))
    bent = submap.keyframe_poses(range(6))
    graphs.forget(submap.id)
    assert desk.n_open(JobKind.GRAPH)
    assert not list(graphs.finish({submap.id: submap}))
    np.testing.assert_array_equal(submap.keyframe_poses(range(6)), bent)
    graphs.new_graph().rebuild(submap)
    assert any(each.rebuilt for each in graphs.finish({submap.id: submap}))


@pytest.mark.slow
def test_a_process_that_is_killed_costs_the_map_nothing(world: PointWorld) -> None:
    """With a real one: its graph is lost, and made anew from the arrays by the next."""
    settings = {"recovery": {"enabled": False, "workers": 1}, "calibration": {"refine": False}}
    config = Config.model_validate(DENSE | settings | {"camera": {"model_sigma_px": 0.0}})
    system = build_system(config, CAMERA)
    system._state.parts = replace(system._state.parts, view_of=lambda frame: world.view(frame.index))
    desk = system.desk.executor
    assert isinstance(desk, WorkerDesk)
    for frame in world.frames():
        system.step(frame)
        if frame.index == 40:
            os.kill(desk.pids[0] or 0, signal.SIGKILL)
    system.finish()
    assert desk.statistics[JobKind.GRAPH].n_done > 5
    assert_right(system, world)


@pytest.mark.parametrize("in_real_time", [False, True])
def test_a_known_graph_near_its_optimum_is_not_made_anew_in_real_time(in_real_time: bool) -> None:
    """It takes in what is new, as with any keyframe, and the window moves the newest ones meanwhile."""
    desk = InlineDesk({JobKind.GRAPH: GraphServer(lambda: ISam2SubmapGraph(Config().graph))})
    windows: list[list[int]] = []
    graphs = BesideGraphs(
        desk,
        lambda submap, k: windows.append(k) or Failure(FailureReason.SOLVER, "no window"),  # type: ignore[func-returns-value]
        partial(open_graph, new_graph=new_isam2),
    )
    graphs.in_real_time = in_real_time
    submap = guessed_submap(make_scene(6, noise_px=0.5), pose_noise=0.02)
    graph = graphs.new_graph()
    graph.rebuild(submap, near_optimum=True)  # not known yet
    assert any(each.rebuilt for each in graphs.finish({submap.id: submap}))
    windows.clear()
    graph.rebuild(submap, near_optimum=True)
    assert windows == ([[5, 4, 3]] if in_real_time else [])
    assert any(each.rebuilt for each in graphs.finish({submap.id: submap})) == (not in_real_time)
    graph.rebuild(submap)  # far from it
    assert any(each.rebuilt for each in graphs.finish({submap.id: submap}))


def test_a_graph_in_another_process_keeps_the_promises_of_one_in_this() -> None:
    """Covariances, factors and the tree are those of a graph that is made here, of the submap as it is."""
    public = {name for name in dir(ISam2SubmapGraph(Config().graph)) if not name.startswith("_")}
    assert not public - set(dir(BesideGraph))
    submap = guessed_submap(make_scene(6, noise_px=0.5), pose_noise=0.02)
    here = new_isam2()
    submap.apply_estimate(*here.update(submap).values)
    graphs = BesideGraphs(InlineDesk({}), no_window, partial(open_graph, new_graph=new_isam2))
    graph = graphs.new_graph()
    with pytest.raises(SolverError, match="empty"):
        graph.pose_covariance(3)
    graph.update(submap)
    before = submap.copy()
    np.testing.assert_allclose(graph.pose_covariance(3), here.pose_covariance(3), rtol=0.2, atol=1e-9)
    ids = np.arange(5)
    np.testing.assert_allclose(graph.point_covariances(ids), here.point_covariances(ids), rtol=0.2, atol=1e-8)
    assert isinstance(graph, BesideGraph)
    np.testing.assert_array_equal(graph.factor_rows, here.factor_rows)
    assert graph.statistics
    assert len(graph.bayes_tree().parent) > 0
    np.testing.assert_array_equal(submap.keyframe_poses(range(6)), before.keyframe_poses(range(6)))
    opened = graph.opened()
    assert graph.opened() is opened
    graph.update(submap)
    assert graph.opened() is not opened
