"""Connections between submaps as factors: solved, doubted, handed back to every submap that they move."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dualslam.atlas.atlas import ROLLOVER_SIGMAS, Link, LinkKind
from dualslam.atlas.moving import bend_submap
from dualslam.atlas.warp import Warp
from dualslam.backend.atlas_solver import GtsamAtlasSolver
from dualslam.backend.submap_graph import ISam2SubmapGraph
from dualslam.core.atlas_problem import AtlasEdge, AtlasProblem, AtlasSolution
from dualslam.core.config.settings import GraphConfig
from dualslam.core.errors import InputError, SolverError
from dualslam.core.events import EventKind
from dualslam.core.geometry import se3, sim3
from dualslam.io.map_store import load_atlas, save_atlas
from dualslam.map.anchors import Anchor
from dualslam.map.submap import Submap
from dualslam.testing.atlas_world import LINK_SIGMAS, DriftingMap, lap_in_submaps

WRONG = np.array([0.0, 0.3, 0.0, 1.5, 0.0, 0.5, 0.3])
"""How far a false connection is off: 17 degrees, 0.4 of the lap's radius, 35 % of scale."""
TINY = np.full(7, 1e-9)
CLOSED = ((0, 3), (2, 123))
"""The same place of the lap, at its begin and after it."""


def rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def state(world: DriftingMap) -> list[np.ndarray]:
    """All that a solution could move."""
    arrays = []
    for submap in world.atlas.submaps.values():
        arrays += [submap.keyframe_poses(list(submap.keyframes)), submap.landmarks["xyz_mu"].copy()]
    arrays += list(world.atlas.S_world_submap(world.atlas.components()[0]).values())
    return arrays


# --- a tree


def test_a_tree_is_laid_out_along_its_links_and_nothing_bends() -> None:
    world = DriftingMap(60)
    for k in range(30):
        world.add(k)
    world.begin_anew()
    S_new_old = sim3.exp([0.2, 1.0, 0.1, 3.0, 4.0, 5.0, 0.6])
    for k in range(25, 60):
        world.add(k, S_new_old)
    before = state(world)[:4]
    link = Link(0, 1, sim3.inverse(S_new_old), np.diag(LINK_SIGMAS**2), LinkKind.RECOVERY, (25, 27, 29))
    report = world.connections.connect([link], world.now)
    assert report
    assert report.factors == {"within": 8, "recovery": 1}
    assert not report.bent
    assert not report.rejected
    assert report.cost_after < 1e-9
    for was, now in zip(before, state(world), strict=False):
        np.testing.assert_array_equal(was, now)
    np.testing.assert_array_equal(world.atlas.S_world_submap([0, 1])[1], link.S_a_b)
    (event,) = world.record.events.of_kind(EventKind.ATLAS_SOLVED)
    assert event.data["submaps"] == [0, 1]


def would_accept(world: DriftingMap, link: Link) -> bool:
    """Whether a solution with the connection would believe it."""
    doubted = replace(link, doubtful=True)
    (skeleton,) = world.connections._problems.now({link.a, link.b}, (doubted,))
    return bool(world.connections._solver.solve(skeleton.problem).believed[-1])


def test_the_only_tie_between_two_maps_is_never_rejected() -> None:
    world = DriftingMap(40)
    for k in range(20):
        world.add(k)
    world.begin_anew()
    for k in range(20, 40):
        world.add(k)
    link = world.loop((0, 18), (1, 22), off=WRONG, sigmas=TINY)
    report = world.connections.connect([link], world.now)
    assert report.rejected == ()
    assert report.newest_chi2 is None, "nothing else says anything of it"
    assert world.atlas.components() == [[0, 1]]


# --- a cycle


@pytest.mark.parametrize("seed", range(3))
def test_a_loop_takes_the_drift_out_of_every_submap(seed: int) -> None:
    world = lap_in_submaps(seed=seed)
    before, pixels = rms(world.errors()), world.pixel_errors()
    report = world.connections.connect([world.loop(*CLOSED)], world.now)
    assert report
    assert report.factors["loop"] == 1
    assert report.factors["rollover"] == 2
    assert report.cost_after < 0.01 * report.cost_before
    assert set(report.bent) == {0, 1, 2}  # archived ones too
    assert rms(world.errors()) < 0.6 * before
    # A bend is smooth: what a keyframe sees stays where it saw it, within a part of a pixel.
    after = world.pixel_errors()
    change = np.array([after[node] - pixels[node] for node in pixels])
    assert np.abs(np.median(change)) < 0.1
    assert np.quantile(change, 0.9) < 1.0
    (S, C) = world.relative(*CLOSED)
    off = sim3.log(sim3.inverse(world.true_S(*CLOSED)) @ S)
    assert off @ np.linalg.solve(C, off) < 24.3  # 0.999 quantile, 7 degrees of freedom


@pytest.mark.parametrize("closed", [False, True])
def test_a_false_connection_with_a_tiny_sigma_is_rejected_and_moves_nothing(closed: bool) -> None:
    world = lap_in_submaps(seed=1)
    if closed:
        world.connections.connect([world.loop(*CLOSED)], world.now)
    before = state(world)
    wrong = world.loop((0, 20), (2, 122), off=WRONG, sigmas=TINY)
    report = world.connections.connect([wrong], world.now)
    assert [link.rejected for link in world.atlas.links] == [False] * (len(world.atlas.links) - 1) + [True]
    assert len(report.newly_rejected) == 1
    for was, now in zip(before, state(world), strict=True):
        np.testing.assert_array_equal(was, now)
    (event,) = world.record.events.of_kind(EventKind.CONNECTION_REJECTED)
    assert event.data["connection"] == "loop"
    # Asked again, it is rejected again, and adds nothing: what is solved once more stays.
    world.connections.settle(world.now)
    for was, now in zip(before, state(world), strict=True):
        np.testing.assert_allclose(was, now, atol=5e-3)


def test_without_doubt_it_is_obeyed() -> None:
    world = lap_in_submaps(seed=1, robust=False)
    world.connections.connect([world.loop(*CLOSED)], world.now)
    good = rms(world.errors())
    wrong = world.loop((0, 20), (2, 122), off=WRONG, sigmas=TINY)
    report = world.connections.connect([wrong], world.now)
    assert not report.rejected
    assert max(report.bent.values()) > 0.1
    assert rms(world.errors()) > 5 * good


def test_a_true_loop_is_not_vetoed_by_a_chain_that_has_drifted_three_times_as_much() -> None:
    drift = 3 * np.array([1e-3] * 3 + [2e-3] * 3 + [4e-3])
    for seed in range(4):
        world = lap_in_submaps(seed=seed, drift=drift)
        before = rms(world.errors())
        report = world.connections.connect([world.loop(*CLOSED)], world.now)
        assert not report.rejected
        assert rms(world.errors()) < 0.7 * before


def test_where_three_contradict_the_first_the_first_goes() -> None:
    world = DriftingMap(235)
    for k in range(100):
        world.add(k)
    world.begin_anew()
    for k in range(110, 235):
        world.add(k, sim3.exp([0.2, 1.0, 0.1, 3.0, 4.0, 5.0, 0.6]))
    world.connections.connect([world.loop((0, 95), (1, 114), off=WRONG, kind=LinkKind.RECOVERY)], world.now)
    assert [link.rejected for link in world.atlas.links] == [False]
    world.connections.connect([world.loop((0, 3), (1, 123))], world.now)
    assert [link.rejected for link in world.atlas.links] == [False, True]
    world.connections.connect([world.loop((0, 40), (1, 160))], world.now)
    report = world.connections.connect([world.loop((0, 80), (1, 200))], world.now)
    assert [link.rejected for link in world.atlas.links] == [True, False, False, False]
    assert len(report.readmitted) == 2
    assert len(report.newly_rejected) == 1
    assert rms(world.errors()) < 0.1
    assert world.atlas.components() == [[0, 1]]


def test_many_true_and_false_ones_at_once() -> None:
    world = DriftingMap(230, seed=3)
    for k in range(230):
        world.add(k)
    rng = np.random.default_rng(3)
    links, true = [], []
    for i in range(20):
        first = int(rng.integers(0, 105))
        true.append(i % 2 == 0)
        off = None if true[-1] else rng.choice([-1, 1], 7) * WRONG
        links.append(world.loop((0, first), (0, first + 120), off=off))
    world.connections.connect(links, world.now)
    assert [not link.rejected for link in world.atlas.links] == true
    assert rms(world.errors()) < 0.05


def test_the_same_again_to_the_bit() -> None:
    runs = []
    for _ in range(2):
        world = lap_in_submaps(seed=2)
        world.connections.connect([world.loop(*CLOSED), world.loop((0, 20), (2, 122), off=WRONG)], world.now)
        runs.append(state(world))
    for a, b in zip(*runs, strict=True):
        np.testing.assert_array_equal(a, b)


def test_what_is_beyond_doubt_shows_how_far_odometry_is_to_be_believed() -> None:
    drift = 8 * np.array([1e-3] * 3 + [2e-3] * 3 + [4e-3])
    world = lap_in_submaps(seed=1, drift=drift)
    before = rms(world.errors())
    late, sure = world.loop((0, 9), (2, 128)), replace(world.loop(*CLOSED), doubtful=False)
    assert not would_accept(world, late), "a chain that thinks that it knows better"
    report = world.connections.connect([sure], world.now)
    assert report.drift > 2
    assert not report.rejected
    assert rms(world.errors()) < 0.7 * before
    late = world.loop((0, 9), (2, 128))
    far, wrong = (world.loop((0, 40), (2, 100), off=off) for off in (None, 3 * WRONG))
    assert [would_accept(world, link) for link in (late, far, wrong)] == [True, True, False]


@pytest.mark.parametrize("way", [0.0, 300.0])
def test_a_seam_holds_at_its_keyframes_however_far_from_the_origin_they_are(way: float) -> None:
    far = np.eye(4)
    far[2, 3] = way
    world = DriftingMap(130)
    for k in range(130):
        world.add(k, far)
        if len(world.submap.keyframes) >= 50 and k < 120:
            world.roll_over()
    for link in world.atlas.links:
        assert within_sigmas(world, link, ROLLOVER_SIGMAS)
    world.connections.connect([replace(world.loop((0, 2), (2, 124)), doubtful=False)], world.now)
    S = world.atlas.S_world_submap([0, 1, 2])
    for link in world.atlas.links[:2]:
        k = link.keyframe_a
        ends = [S[m] @ world.atlas.submaps[m].T_submap_kf[k] for m in (link.a, link.b)]
        apart = sim3.log(sim3.inverse(ends[0]) @ ends[1])
        assert np.linalg.norm(apart[3:6]) < 5 * ROLLOVER_SIGMAS[3]


def within_sigmas(world: DriftingMap, link: Link, sigmas: np.ndarray) -> bool:
    """Whether a link's covariance is these sigmas at its second keyframe."""
    k = link.attached(world.atlas)[1]
    Ad = sim3.adjoint(sim3.inverse(world.atlas.submaps[link.b].T_submap_kf[k]))
    return bool(np.allclose(Ad @ link.covariance @ Ad.T, np.diag(sigmas**2), rtol=1e-3, atol=1e-9))


# --- the transaction


def test_a_rigid_move_and_a_change_of_unit_leave_every_pixel_where_it_was() -> None:
    world = DriftingMap(30)
    for k in range(30):
        world.add(k)
    submap = world.submap
    submap.remove_keyframe(12, 11)
    before, S = world.pixel_errors(), sim3.exp([0.3, -0.2, 0.5, 2.0, 1.0, -1.0, 0.7])
    culled = submap.resolve_anchor(12, np.eye(4))
    bend_submap(submap, Warp(np.array([0, 29]), np.array([S, S])))
    after = world.pixel_errors()
    np.testing.assert_allclose([after[node] for node in before], list(before.values()), atol=1e-9)
    np.testing.assert_allclose(submap.resolve_anchor(12, np.eye(4)), sim3.act_on_pose(S, culled), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(submap.landmarks["normal"], axis=1), 1, atol=1e-9)


def test_frames_culled_keyframes_and_links_go_with_the_keyframes_around_them() -> None:
    world = lap_in_submaps(seed=1)
    submap = world.atlas.submaps[1]
    inner = sorted(submap.keyframes)[20]
    submap.remove_keyframe(inner, inner - 1)  # one that only a frame's pose, and an anchor, remember
    assert isinstance(submap.anchors[inner], Anchor)
    world.connections.connect([world.loop(*CLOSED)], world.now)
    T = submap.resolve_anchor(inner, np.eye(4))
    between = 0.5 * (submap.T_submap_kf[inner - 1] + submap.T_submap_kf[inner + 1])[:3, 3]
    step = np.linalg.norm(submap.T_submap_kf[inner + 1][:3, 3] - submap.T_submap_kf[inner - 1][:3, 3])
    assert np.linalg.norm(T[:3, 3] - between) < 0.2 * step
    pose = world.record.poses[inner]
    np.testing.assert_allclose(submap.resolve_anchor(pose.keyframe_id, pose.T_kf_cam), T, atol=1e-9)
    # Each link says of its two keyframes what it said before: a solution moves no measurement.
    loop = world.atlas.links[-1]
    (k_a, k_b), (m_a, m_b) = loop.attached(world.atlas), (loop.a, loop.b)
    maps = world.atlas.submaps
    S_ka_kb = sim3.inverse(maps[m_a].T_submap_kf[k_a]) @ loop.S_a_b @ maps[m_b].T_submap_kf[k_b]
    off = sim3.log(sim3.inverse(world.true_S(*CLOSED)) @ S_ka_kb)
    assert np.abs(off / LINK_SIGMAS).max() < 6


def test_a_bend_outlasts_a_new_solution_of_the_submap() -> None:
    world = lap_in_submaps(seed=2)
    for submap in world.atlas.submaps.values():
        solve(submap)
    report = world.connections.connect([world.loop(*CLOSED)], world.now)
    for m, submap in world.atlas.submaps.items():
        bent = submap.copy()
        solve(submap)
        back = max(np.linalg.norm(submap.T_submap_kf[k][:3, 3] - bent.T_submap_kf[k][:3, 3]) for k in bent.keyframes)
        assert back < 0.2 * report.bent[m] + 0.01
        bent.relative_poses = {}
        straight = bent.copy()
        solve(straight)
        gone = max(np.linalg.norm(straight.T_submap_kf[k][:3, 3] - bent.T_submap_kf[k][:3, 3]) for k in bent.keyframes)
        assert gone > 0.7 * report.bent[m]  # what would have happened without
    good = rms(world.errors())
    world.connections.settle(world.now)  # the bend itself is no evidence: nothing adds up
    assert rms(world.errors()) < 1.05 * good


def test_a_bend_that_another_camera_has_straightened_out_is_not_taken_out_twice() -> None:
    drift = 3 * np.array([1e-3] * 3 + [2e-3] * 3 + [4e-3])
    world = lap_in_submaps(seed=2, drift=drift)
    world.connections.connect([world.loop(*CLOSED)], world.now)
    good = rms(world.errors())
    for m, submap in world.atlas.submaps.items():
        before, warp = submap.copy(), world.atlas.warps[m]
        submap.relative_poses = {}  # what held the bend
        bend_submap(submap, Warp(warp.index, sim3.inverse(warp.S)))
        world.connections.follow(before, submap, world.now)
    assert not any(link.rejected for link in world.atlas.links)
    assert rms(world.errors()) < 1.1 * good


def solve(submap: Submap) -> None:
    estimate = ISam2SubmapGraph(GraphConfig()).rebuild(submap)
    submap.apply_estimate(*estimate.values)


class FrontEnd:
    """Notes what it is told."""

    def __init__(self, submap: Submap) -> None:
        self.submap = submap
        self.adopted: list[Submap] = []

    def adopt(self, graph: object, before: Submap) -> None:
        self.adopted.append(before)


def test_the_live_front_end_hears_of_a_bend_and_of_nothing_else() -> None:
    world = lap_in_submaps(seed=1)
    front_end = FrontEnd(world.submap)
    world.front_ends.append(front_end)
    before = world.submap.keyframe_poses(list(world.submap.keyframes))
    world.connections.connect([world.loop((0, 20), (2, 122), off=WRONG)], world.now)
    assert not front_end.adopted
    world.connections.connect([world.loop(*CLOSED)], world.now)
    (was,) = front_end.adopted
    np.testing.assert_array_equal(was.keyframe_poses(list(was.keyframes)), before)
    assert front_end.submap is world.atlas.submaps[2]


class Broken(GtsamAtlasSolver):
    def solve(self, problem: AtlasProblem) -> AtlasSolution:
        raise SolverError("no")


def test_a_solver_that_fails_leaves_everything_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    world = lap_in_submaps(seed=1)
    before = state(world)
    monkeypatch.setattr(world.connections, "_solver", Broken(True, 0.8))
    report = world.connections.connect([world.loop(*CLOSED)], world.now)
    assert not report
    assert len(world.atlas.links) == 2
    for was, now in zip(before, state(world), strict=True):
        np.testing.assert_array_equal(was, now)


def test_a_change_by_the_submaps_own_graph_takes_links_along_and_solves_again() -> None:
    world = lap_in_submaps(seed=1)
    world.connections.connect([world.loop(*CLOSED)], world.now)
    good, submap = rms(world.errors()), world.atlas.submaps[1]
    n_events = len(world.record.events)
    before = submap.copy()
    S = sim3.exp([0.0, 0.02, 0.0, 0.1, 0.0, 0.0, 0.05])  # all of it, as a calibration might
    submap.transform(float(sim3.scale(S)), se3.from_parts(sim3.rotation(S), sim3.translation(S)))
    world.connections.follow(before, submap, world.now)
    assert len(world.record.events) > n_events
    assert abs(rms(world.errors()) - good) < 0.1 * good


@pytest.mark.parametrize("doubtful", [True, False])
def test_the_report_says_how_far_the_newest_connection_lies_from_all_others(doubtful: bool) -> None:
    true, false = (
        world.connections.connect([replace(world.loop(*CLOSED, off=off), doubtful=doubtful)], world.now).newest_chi2
        for world, off in ((lap_in_submaps(seed=1), None), (lap_in_submaps(seed=1), WRONG))
    )
    assert true is not None
    assert 0 < true < 20
    assert false is not None
    assert false > 60


def test_covariance_across_submaps_shrinks_with_a_loop() -> None:
    world = lap_in_submaps(seed=1)
    _, before = world.relative((0, 10), (2, 120))
    world.connections.connect([world.loop(*CLOSED)], world.now)
    S, after = world.relative((0, 10), (2, 120))
    assert np.trace(after) < 0.2 * np.trace(before)
    np.testing.assert_allclose(after, after.T)
    assert (np.linalg.eigvalsh(after) > 0).all()
    placed = world.atlas.S_world_submap([0, 1, 2])
    maps = world.atlas.submaps
    nodes = [placed[m] @ maps[m].T_submap_kf[k] for m, k in ((0, 10), (2, 120))]
    np.testing.assert_allclose(S, sim3.inverse(nodes[0]) @ nodes[1], atol=1e-9)
    world.begin_anew()
    world.add(60)
    with pytest.raises(SolverError, match="not connected"):
        world.relative((0, 10), (3, 60))


# --- on the disk


@pytest.fixture
def closed_world() -> DriftingMap:
    world = lap_in_submaps(seed=1)
    world.connections.connect([world.loop(*CLOSED), world.loop((0, 20), (2, 122), off=WRONG)], world.now)
    world.atlas.submaps[0].condemn(range(40, 50))
    return world


def test_a_map_comes_back_with_all_that_was_solved(closed_world: DriftingMap, tmp_path: Path) -> None:
    atlas = closed_world.atlas
    save_atlas(tmp_path / "map", atlas, closed_world.record.poses)
    stored = load_atlas(tmp_path / "map").atlas
    assert [link.rejected for link in stored.links] == [False, False, False, True]
    assert [(link.keyframe_a, link.keyframe_b) for link in stored.links[2:]] == [(3, 123), (20, 122)]
    assert [link.doubtful for link in stored.links] == [False, False, True, True]
    was, now = (a.S_world_submap([0, 1, 2]) for a in (atlas, stored))
    for m in was:
        np.testing.assert_array_equal(was[m], now[m])
    assert stored.held == atlas.held
    for m, warp in atlas.warps.items():
        np.testing.assert_array_equal(stored.warps[m].S, warp.S)
    assert stored.submaps[0].condemned == set(range(40, 50))
    marked = stored.submaps[0].landmarks["condemned"]
    assert 0 < marked.sum() < len(marked)
    ids = stored.submaps[0].landmarks_of_keyframes(range(40))
    assert not marked[ids].any()


def test_a_map_of_the_next_version_is_refused(closed_world: DriftingMap, tmp_path: Path) -> None:
    folder = tmp_path / "map"
    save_atlas(folder, closed_world.atlas, closed_world.record.poses)
    document = json.loads((folder / "map.json").read_text())
    (folder / "map.json").write_text(json.dumps(document | {"format": 9}))
    with pytest.raises(InputError, match=r"format 9, newer than"):
        load_atlas(folder)


def test_each_edge_goes_from_a_keyframe_to_a_keyframe() -> None:
    edge = AtlasEdge(0, 1, np.eye(4), np.eye(7), "loop")
    assert not edge.doubtful
    problem = AtlasProblem(np.array([np.eye(4)] * 2), 0, (edge,))
    solution = GtsamAtlasSolver(True, 0.8).solve(problem)
    np.testing.assert_array_equal(solution.S_world_node, problem.S_world_node)
    np.testing.assert_allclose(
        GtsamAtlasSolver(True, 0.8).relative_covariances(problem, 0)[1], np.eye(7), rtol=1e-4, atol=1e-5
    )
