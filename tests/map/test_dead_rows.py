"""Dead observations leave the table of a map in use, and nothing that is made of the map notices."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.backend.submap_graph import ISam2SubmapGraph
from dualslam.core.config.settings import GraphConfig
from dualslam.core.estimates import GraphEstimate
from dualslam.core.jobs import InlineDesk, JobKind
from dualslam.core.types import Failure, FailureReason, IntArray
from dualslam.map import submap_delta
from dualslam.map.graph_beside import BesideGraphs, GraphJob, GraphServer
from dualslam.map.submap import Submap
from dualslam.map.submap_delta import SubmapMirror, drop_dead_rows
from dualslam.system.system import System
from dualslam.testing.graph_scene import Feeder, make_scene
from dualslam.testing.late_desk import LateDesk
from dualslam.testing.point_world import PointWorld, cloud, hand_held, system_in

N = 30
Observation = tuple[int, int, int]


def named(submap: Submap, rows: IntArray) -> list[Observation]:
    """Keyframe, feature and landmark of some rows, in their order."""
    return list(zip(*(submap.observations[name][rows].tolist() for name in ("kf", "feature", "landmark")), strict=True))


def spoil(submap: Submap, k: int) -> None:
    """Let a keyframe see two landmarks by each other's features, as a wrong match does: outliers of the graph."""
    rows = np.flatnonzero((submap.observations["kf"] == k) & submap.observations["alive"])[:2]
    feature, landmark = submap.observations["feature"][rows], submap.observations["landmark"][rows]
    submap.remove_observations(rows)
    submap.add_observations(k, feature, landmark[::-1])


def changes(feeder: Feeder, k: int) -> None:
    """One more keyframe, of which two views are wrong; another one and some landmarks are culled."""
    feeder.add(k)
    submap = feeder.submap
    spoil(submap, k)
    if k % 3 == 0:
        submap.remove_keyframe(k - 4, k - 3)
        submap.remove_landmarks(np.flatnonzero(submap.landmarks["alive"])[::40])


def begun() -> Feeder:
    feeder = Feeder(make_scene(N, 120, 0.5))
    for k in range(4):
        feeder.add(k, exact=True)
    feeder.submap.gauge = (0, 3)
    return feeder


def assert_same(a: GraphEstimate, b: GraphEstimate) -> None:
    for name in ("keyframe_ids", "T_submap_kf", "landmark_ids", "xyz_mu"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert (a.noise2, a.rebuilt) == (b.noise2, b.rebuilt)


@pytest.fixture
def no_minimum(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small maps drop their rows, too."""
    monkeypatch.setattr(submap_delta, "MIN_DEAD", 1)


class All:
    """Drops whatever may be dropped, not only once it is the larger part."""

    def __init__(self) -> None:
        self.n_dropped = 0

    def __call__(self, submap: Submap, graph: ISam2SubmapGraph | SubmapMirror) -> None:
        stays = np.ones(len(submap.observations), np.bool_)
        stays[graph.rows_out(submap)] = False
        submap.keep_observations(np.flatnonzero(stays))
        graph.keep_rows(np.flatnonzero(stays))
        self.n_dropped += int(np.count_nonzero(~stays))


def test_a_graph_whose_submap_drops_its_dead_rows_gives_the_same_estimates() -> None:
    feeders, drop, n_outliers, n_waited = [begun(), begun()], All(), 0, 0
    graphs = [ISam2SubmapGraph(GraphConfig()) for _ in feeders]
    for k in range(3, N):
        estimates = []
        for feeder, graph in zip(feeders, graphs, strict=True):
            submap = feeder.submap
            if k > 3:
                changes(feeder, k)
            if feeder is feeders[1]:
                n_waited += np.count_nonzero(~submap.observations["alive"]) > len(graph.rows_out(submap))
                drop(submap, graph)  # what has died just now is still in the graph: it stays
            estimate = graph.rebuild(submap) if k == 20 else graph.update(submap)
            submap.apply_estimate(*estimate.values)
            estimates.append((estimate, named(submap, estimate.outlier_rows)))
            submap.remove_outliers(estimate.outlier_rows)
        assert_same(estimates[0][0], estimates[1][0])
        assert estimates[0][1] == estimates[1][1]
        n_outliers += len(estimates[0][1])
        factors = [named(feeder.submap, graph.factor_rows) for feeder, graph in zip(feeders, graphs, strict=True)]
        assert factors[0] == factors[1]
    assert drop.n_dropped > 500
    assert n_outliers > 5
    assert n_waited
    plain, thin = (feeder.submap for feeder in feeders)
    assert len(thin.observations) == len(plain.observations) - drop.n_dropped
    np.testing.assert_array_equal(thin.n_observations(np.arange(50)), plain.n_observations(np.arange(50)))


def test_a_replica_follows_a_submap_that_drops_its_dead_rows_and_its_graph_too() -> None:
    feeders, drop, n_outliers = [begun(), begun()], All(), 0
    mirrors = [SubmapMirror() for _ in feeders]
    servers = [GraphServer(lambda: ISam2SubmapGraph(GraphConfig())) for _ in feeders]
    for k in range(3, N):
        answers = []
        for feeder, mirror, server in zip(feeders, mirrors, servers, strict=True):
            submap = feeder.submap
            if k > 3:
                changes(feeder, k)
            if feeder is feeders[1]:
                drop(submap, mirror)
            delta = mirror.delta(submap)
            assert delta.is_whole == (k == 3)
            answer = server(GraphJob(0, delta, k == 20, True))
            assert isinstance(answer, GraphEstimate)
            replica = server._graphs[0][0]
            np.testing.assert_array_equal(replica.observations["alive"], submap.observations["alive"])
            rows = answer.outlier_rows
            answers.append((answer, named(submap, rows)))
            assert named(replica, rows) == named(submap, rows)
            submap.apply_estimate(*answer.values)
            submap.remove_outliers(rows)
        assert_same(answers[0][0], answers[1][0])
        assert answers[0][1] == answers[1][1]
        n_outliers += len(answers[0][1])
    assert drop.n_dropped > 500
    assert n_outliers > 5


def test_rows_that_go_without_a_word_cost_a_graph_and_a_replica_their_state() -> None:
    feeder, graph, mirror = begun(), ISam2SubmapGraph(GraphConfig()), SubmapMirror()
    submap = feeder.submap
    graph.update(submap)
    mirror.delta(submap)
    changes(feeder, 4)
    submap.keep_observations(np.flatnonzero(submap.observations["alive"]))
    assert not len(graph.rows_out(submap))
    assert not len(mirror.rows_out(submap))
    assert graph.update(submap).rebuilt
    assert not graph.update(submap).rebuilt
    assert mirror.delta(submap).is_whole
    assert not mirror.delta(submap).is_whole
    # Told of too much, it does not believe it.
    changes(feeder, 5)
    submap.remove_keyframe(2, 1)
    kept = np.flatnonzero(submap.observations["alive"])
    submap.keep_observations(kept)
    graph.keep_rows(kept)
    assert graph.update(submap).rebuilt


def test_rows_that_live_do_not_leave_the_table() -> None:
    submap = begun().submap
    with pytest.raises(ValueError, match="live observations"):
        submap.keep_observations(np.arange(5))


@pytest.mark.usefixtures("no_minimum")
def test_few_dead_rows_stay() -> None:
    feeder, graph = begun(), ISam2SubmapGraph(GraphConfig())
    submap = feeder.submap
    submap.remove_observations(np.arange(len(submap.observations) // 2 - 1))
    graph.update(submap)
    assert drop_dead_rows(submap, graph) == 0
    submap.remove_observations(np.flatnonzero(submap.observations["alive"])[:2])
    assert drop_dead_rows(submap, graph) == 0  # these two may still be in the graph
    graph.update(submap)
    assert drop_dead_rows(submap, graph) > 0
    assert submap.observations["alive"].all()


def there_and_back(n: int) -> PointWorld:
    """A camera that goes the same short way again and again."""
    way = hand_held(24)
    turns = np.abs((np.arange(n) + 23) % 46 - 23)
    return PointWorld(cloud(600), way[turns])


DENSE = {"keyframes": {"max_parallax_deg": 2.0}}


def went(world: PointWorld, system: System) -> tuple[System, list[float]]:
    """A run, and how many times as long as its live part the table was at each frame."""
    lengths = []
    for frame in world.frames():
        system.step(frame)
        if system.live is not None:
            obs = system.live.submap.observations
            lengths.append(len(obs) / np.count_nonzero(obs["alive"]))
    system.finish()
    return system, lengths


@pytest.mark.usefixtures("no_minimum")
def test_the_table_of_a_camera_that_stays_is_bounded_and_its_poses_are_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = there_and_back(100)
    thin, lengths = went(world, system_in(world, **DENSE))
    monkeypatch.setattr(submap_delta, "MIN_DEAD", 1 << 60)
    plain, unbounded = went(world, system_in(world, **DENSE))
    assert thin.atlas.submaps[0].n_dropped > 0
    assert unbounded[-1] > max(lengths)
    assert max(lengths) < 2.6  # the rows that died since the last update of the graph come on top
    assert thin.poses.keys() == plain.poses.keys()
    for i, pose in plain.poses.items():
        np.testing.assert_array_equal(pose.T_kf_cam, thin.poses[i].T_kf_cam)
    for k, T in plain.atlas.submaps[0].T_submap_kf.items():
        np.testing.assert_array_equal(T, thin.atlas.submaps[0].T_submap_kf[k])


@pytest.mark.usefixtures("no_minimum")
def test_answers_that_come_late_name_the_rows_that_were_sent() -> None:
    """No row leaves while a graph is solving: what it calls an outlier is what it was sent as such a row."""
    server, told = GraphServer(lambda: ISam2SubmapGraph(GraphConfig())), []

    def solve(job: GraphJob) -> GraphEstimate | Failure:
        answer = server(job)
        assert isinstance(answer, GraphEstimate)
        told.append(named(server._graphs[job.graph_id][0], answer.outlier_rows))
        return answer

    desk = LateDesk(InlineDesk({JobKind.GRAPH: solve}), 2)
    graphs = BesideGraphs(
        desk,
        lambda submap, k: Failure(FailureReason.SOLVER, "no window"),
        lambda submap: ISam2SubmapGraph(GraphConfig()),
    )
    feeder = begun()
    submap, graph, n = feeder.submap, graphs.new_graph(), 0
    for k in range(4, N):
        changes(feeder, k)
        submap.remove_landmarks(np.flatnonzero(submap.landmarks["alive"])[::3])
        graph.update(submap)
        before = set(named(submap, np.flatnonzero(submap.observations["alive"])))
        for moved in graphs.collect({submap.id: submap}):
            gone = before - set(named(submap, np.flatnonzero(submap.observations["alive"])))
            wanted = before & set(told[len(told) - 1 - (desk.n_open(JobKind.GRAPH) > 0)])
            touched = {j for _, _, j in wanted}
            assert wanted <= gone
            assert {j for _, _, j in gone} <= touched
            assert moved.submap is submap
            n += len(wanted)
    assert n > 0
    assert submap.n_dropped > 0
