"""A solution of the atlas that comes late, to a map that has gone on meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from dualslam.atlas.atlas import Link, LinkKind
from dualslam.atlas.report import AtlasReport
from dualslam.core.geometry import se3, sim3
from dualslam.core.jobs import Ended, InlineDesk, JobKind
from dualslam.core.types import Failure, FailureReason, FloatArray
from dualslam.map.submap import Submap
from dualslam.testing.atlas_world import LINK_SIGMAS, DriftingMap, lap_in_submaps
from dualslam.testing.late_desk import LateDesk
from tests.atlas.test_atlas_graph import CLOSED, FrontEnd, rms, state
from tests.seeds import first_of

POLLS = 3


class CountingDesk(LateDesk):
    """Notes what it was asked; the first answers may be failures."""

    def __init__(self, inner: InlineDesk, polls: int, failures: tuple[FailureReason, ...] = ()) -> None:
        super().__init__(inner, polls)
        self.asked: list[object] = []
        self._failures = list(failures)

    def submit(self, kind: JobKind, work: object, of: int | None = None) -> None:
        """Do the work, or lose it."""
        self.asked.append(work)
        super().submit(kind, work, of)
        if self._failures:
            at, ended = self.waiting[kind].pop()
            self.waiting[kind].append((at, Ended(ended.work, Failure(self._failures.pop(0), "it died"))))


def late(
    seed: int = 1, polls: int = POLLS, failures: tuple[FailureReason, ...] = ()
) -> tuple[DriftingMap, CountingDesk, FrontEnd]:
    """A lap whose atlas is solved late, with the front end that tracks in the newest submap."""
    world = lap_in_submaps(seed=seed)
    desk = CountingDesk(world.connections._desk, polls, failures)  # type: ignore[arg-type]
    world.connections._desk = desk
    front_end = FrontEnd(world.submap)
    world.front_ends.append(front_end)
    return world, desk, front_end


def immediate(seed: int = 1) -> DriftingMap:
    world = lap_in_submaps(seed=seed)
    world.connections.connect_later(world.loop(*CLOSED), world.now)
    return world


def wait(world: DriftingMap, frames: int = 40) -> list[AtlasReport]:
    reports = [world.connections.collect(world.now) for _ in range(frames)]
    assert not world.connections.is_solving
    return [report for report in reports if report is not None]


def moved(before: list[np.ndarray], world: DriftingMap) -> list[bool]:
    """Whether keyframes of each submap have moved."""
    after = state(world)
    n = len(world.atlas.submaps)
    return [not np.array_equal(before[2 * m], after[2 * m]) for m in range(n)]


def assert_same(world: DriftingMap, other: DriftingMap, atol: float = 1e-9) -> None:
    for a, b in zip(state(world), state(other), strict=True):
        np.testing.assert_allclose(a, b, atol=atol)
    for link, as_there in zip(world.atlas.links, other.atlas.links, strict=True):
        np.testing.assert_allclose(link.S_a_b, as_there.S_a_b, atol=atol)
        np.testing.assert_allclose(link.covariance, as_there.covariance, atol=atol)
        assert link.rejected == as_there.rejected
    assert world.atlas.held == other.atlas.held
    np.testing.assert_allclose(world.errors(), other.errors(), atol=atol)


# --- nothing happens meanwhile


@pytest.mark.parametrize("seed", first_of(range(2)))
def test_late_it_is_the_same_atlas_and_the_live_submap_follows_first(seed: int) -> None:
    world, _, front_end = late(seed)
    before = state(world)
    assert world.connections.connect_later(world.loop(*CLOSED), world.now) is None
    steps = []
    while world.connections.is_solving:
        report = world.connections.collect(world.now)
        steps.append((report is not None, moved(before, world), len(front_end.adopted)))
    n = POLLS - 1  # it was asked for once already
    assert steps[n - 1] == (False, [False, False, False], 0)
    assert steps[n] == (True, [False, False, True], 1)
    assert [sum(bent) for _, bent, _ in steps[n:]] == [1, 1, 2, 2, 3, 3], "and its points in the step after"
    assert_same(world, immediate(seed))


def test_at_the_end_of_a_run_what_is_under_way_is_waited_for() -> None:
    world, _, _ = late(polls=100_000)
    assert world.connections.connect_later(world.loop(*CLOSED), world.now) is None
    assert world.connections.finish(world.now)
    assert_same(world, immediate())
    assert world.connections.connect_later(world.loop((0, 4), (2, 124)), world.now), "from then on at once"


def test_what_is_left_to_move_is_moved_when_the_run_ends() -> None:
    world, _, _ = late(polls=1)
    assert world.connections.connect_later(world.loop(*CLOSED), world.now) is None
    assert world.connections.collect(world.now)
    assert world.connections.is_solving
    assert world.connections.finish(world.now) is None
    assert_same(world, immediate())


def test_what_graphs_are_solving_of_bent_submaps_is_of_no_more_use() -> None:
    world, _, _ = late()
    forgotten: list[int] = []
    world.connections._mover._forget_graph = forgotten.append
    assert world.connections.connect_later(world.loop(*CLOSED), world.now) is None
    (report,) = wait(world)
    assert sorted(forgotten) == sorted(report.bent)


# --- the map goes on


def test_keyframes_and_a_rollover_that_come_meanwhile_go_along() -> None:
    n, n_later = 130, 150
    world = DriftingMap(n_later, seed=1)
    reference = lap_in_submaps(seed=1)
    for k in range(n):
        world.add(k)
        if len(world.submap.keyframes) >= 50 and k < n - 10:
            world.roll_over()
    before = rms(world.errors())
    desk = world.connections._desk = CountingDesk(world.connections._desk, POLLS)  # type: ignore[arg-type]
    world.front_ends.append(FrontEnd(world.submap))
    assert world.connections.connect_later(world.loop(*CLOSED), world.now) is None
    for k in range(n, 140):
        world.add(k)
    full, T_before = world.submap, {k: world.submap.T_submap_kf[k].copy() for k in range(128, 140)}
    world.roll_over()
    assert world.atlas.components() == [[0, 1, 2, 3]], "at once: nothing else ties it"
    for k in range(140, n_later):
        world.add(k)
    (report,) = wait(world)
    assert report.factors["loop"] == 1
    assert len(desk.asked) == 2, "once more, with the submap that has come"
    assert world.atlas.placement.keys() == {0, 1, 2, 3}
    assert rms(world.errors()) < 0.6 * before
    assert rms(world.errors()[:n]) < 1.2 * rms(immediate().errors())
    # What has come since stands to its neighbours as it did.
    for k in range(131, 140):
        was = se3.inverse(T_before[k - 1]) @ T_before[k]
        now = se3.inverse(full.T_submap_kf[k - 1]) @ full.T_submap_kf[k]
        np.testing.assert_allclose(now[:3, :3], was[:3, :3], atol=2e-3)
        np.testing.assert_allclose(now[:3, 3], was[:3, 3] * (now[2, 3] / was[2, 3]), atol=2e-3)
    assert len(reference.atlas.submaps) == 3
    S, C = world.relative(*CLOSED)
    off = sim3.log(sim3.inverse(world.true_S(*CLOSED)) @ S)
    assert off @ np.linalg.solve(C, off) < 24.3  # 0.999 quantile, 7 degrees of freedom


def test_what_a_graph_has_found_meanwhile_is_kept() -> None:
    world, desk, _ = late()
    as_if = immediate()
    rng = np.random.default_rng(0)
    assert world.connections.connect_later(world.loop(*CLOSED), world.now) is None
    at_once = as_if.atlas.submaps[2].keyframe_poses(list(as_if.submap.keyframes))
    change = se3.exp(1e-3 * rng.normal(size=(len(at_once), 6)))
    for k, T in zip(world.submap.keyframes, change, strict=True):
        world.submap.T_submap_kf[k] = world.submap.T_submap_kf[k] @ T
    assert wait(world)
    assert len(desk.asked) == 1
    now = world.submap.keyframe_poses(list(world.submap.keyframes))
    np.testing.assert_allclose(now[:, :3, :3], (at_once @ change)[:, :3, :3], atol=1e-3)
    np.testing.assert_allclose(now[:, :3, 3], (at_once @ change)[:, :3, 3], atol=2e-3)


def merge(world: DriftingMap, n: int = 20) -> Link:
    """Another map of the same place, joined with the first by the only connection between them."""
    world.begin_anew()
    S = sim3.exp([0.2, 1.0, 0.1, 3.0, 4.0, 5.0, 0.6])
    for k in range(60, 60 + n):
        world.add(k, S)
    T_true_link = world.true_S((1, 65), (3, 65))
    return Link.of_keyframes(world.atlas, (1, 65), (3, 65), T_true_link, np.diag(LINK_SIGMAS**2), LinkKind.RECOVERY)


def test_a_map_that_is_joined_meanwhile_comes_along() -> None:
    world, desk, _ = late()
    assert world.connections.connect_later(world.loop(*CLOSED), world.now) is None
    link = merge(world)
    assert world.connections.connect([link], world.now)
    assert world.atlas.components() == [[0, 1, 2, 3]]
    (report,) = wait(world)
    assert report.factors["loop"] == 1
    assert len(desk.asked) == 2
    S, C = world.relative((1, 65), (3, 65))
    off = sim3.log(sim3.inverse(world.true_S((1, 65), (3, 65))) @ S)
    assert off @ np.linalg.solve(C, off) < 24.3
    assert rms(world.errors()) < 1.2 * rms(immediate().errors())


def test_a_loose_link_that_is_measured_again_moves_its_map_even_while_the_atlas_is_being_solved() -> None:
    world, *_ = late()
    sure = merge(world)
    too_large = sim3.exp([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.08])
    covariance = sure.covariance + np.diag([0.0] * 6 + [0.04**2])
    loose = replace(sure, S_a_b=sure.S_a_b @ too_large, covariance=covariance, is_sure=False)
    assert world.connections.connect([loose], world.now)
    wait(world)
    assert world.atlas.components(sure=True) == [[0, 1, 2], [3]]
    assert world.connections.connect_later(world.loop(*CLOSED), world.now) is None
    assert world.connections.tighten(sure, world.now)
    assert not world.connections.tighten(loose, world.now)
    wait(world)
    assert world.atlas.components(sure=True) == [[0, 1, 2, 3]]
    assert [link.kind for link in world.atlas.links].count(LinkKind.RECOVERY) == 1
    S, _ = world.relative((1, 65), (3, 65))
    off = sim3.scale(sim3.inverse(world.true_S((1, 65), (3, 65))) @ S)
    assert abs(off - 1.0) < 0.02


# --- the solution is void


def follow_another_camera(world: DriftingMap) -> None:
    """Submap 1 is changed by others: all is half as large again."""
    submap, before = world.atlas.submaps[1], world.atlas.submaps[1].copy()
    submap.transform(1.5, np.eye(4))
    world.connections.follow(before, submap, world.now)


def cull_a_node(world: DriftingMap) -> None:
    *_, anchor, newest = world.submap.keyframes
    world.submap.remove_keyframe(newest, anchor)


def straighten_far(world: DriftingMap) -> None:
    """Its own graph moves the newest keyframes of a submap by a tenth of the way from node to node."""
    submap = world.atlas.submaps[2]
    for k in list(submap.keyframes)[-5:]:
        submap.T_submap_kf[k] = submap.T_submap_kf[k] @ se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, 0.2])


@pytest.mark.parametrize("interfere", [follow_another_camera, cull_a_node, straighten_far])
def test_where_the_problem_is_another_one_it_is_solved_again(interfere: Callable[[DriftingMap], None]) -> None:
    world, desk, _ = late()
    before = rms(world.errors())
    as_if = lap_in_submaps(seed=1)
    assert world.connections.connect_later(world.loop(*CLOSED), world.now) is None
    interfere(world)
    (report,) = wait(world)
    assert report.factors["loop"] == 1
    assert len(desk.asked) == 2
    link = as_if.loop(*CLOSED)  # measured before, as there
    T_then = [as_if.atlas.submaps[m].T_submap_kf[k].copy() for m, k in CLOSED]
    interfere(as_if)
    T_now = [as_if.atlas.submaps[m].resolve_anchor(k, np.eye(4)) for m, k in CLOSED]
    S_a_b = T_now[0] @ se3.inverse(T_then[0]) @ link.S_a_b @ T_then[1] @ se3.inverse(T_now[1])
    as_if.connections.connect_later(replace(link, S_a_b=S_a_b), as_if.now)
    assert rms(world.errors()[:120]) < 0.7 * before
    np.testing.assert_allclose(world.errors(), as_if.errors(), atol=0.02 * before)


def test_a_solution_made_at_once_in_between_makes_the_late_one_void() -> None:
    world, desk, _ = late()
    assert world.connections.connect_later(world.loop(*CLOSED), world.now) is None
    assert world.connections.connect([world.loop((0, 6), (2, 126), kind=LinkKind.RECOVERY)], world.now)
    (report,) = wait(world)
    assert report.factors["loop"] == 1
    assert report.factors["recovery"] == 1
    assert len(desk.asked) == 2
    assert not any(link.rejected for link in world.atlas.links)
    assert rms(world.errors()) < 1.2 * rms(immediate().errors())


def test_a_submap_that_others_change_before_its_turn_is_solved_again() -> None:
    world, desk, _ = late(polls=1)
    before = rms(world.errors())
    assert world.connections.connect_later(world.loop(*CLOSED), world.now) is None
    assert world.connections.collect(world.now)
    follow_another_camera(world)
    wait(world)
    assert len(desk.asked) == 2
    assert rms(world.errors()) < 0.6 * before


# --- workers that die, solvers that fail


@pytest.mark.parametrize("reason", [FailureReason.WORKER, FailureReason.TIMEOUT, FailureReason.BUSY])
def test_a_worker_that_dies_costs_the_job_alone(reason: FailureReason) -> None:
    world, desk, _ = late(failures=(reason,))
    assert world.connections.connect_later(world.loop(*CLOSED), world.now) is None
    assert wait(world)
    assert len(desk.asked) == 2
    assert_same(world, immediate())


def test_where_all_workers_die_it_is_solved_here() -> None:
    world, desk, _ = late(failures=(FailureReason.WORKER,) * 9)
    assert world.connections.connect_later(world.loop(*CLOSED), world.now) is None
    (report,) = wait(world)
    assert report
    assert len(desk.asked) == 3
    assert_same(world, immediate())


def test_a_solver_that_fails_leaves_all_as_it_is() -> None:
    world, _, _ = late(failures=(FailureReason.SOLVER,))
    before, n_links = state(world), len(world.atlas.links)
    assert world.connections.connect_later(world.loop(*CLOSED), world.now) is None
    (report,) = wait(world)
    assert not report
    assert len(world.atlas.links) == n_links
    for was, now in zip(before, state(world), strict=True):
        np.testing.assert_array_equal(was, now)


# --- covariances come late as well


def test_with_late_covariances_nothing_is_computed_in_between() -> None:
    world, desk, _ = late()
    world.connections._problems.covariances._desk = desk
    computed: list[int] = []
    compute = world.connections._problems.covariances._compute

    def count(submap: Submap, pairs: Sequence[tuple[int, int]], held: frozenset[int]) -> FloatArray:
        computed.append(submap.id)
        return compute(submap, pairs, held)

    world.connections._problems.covariances._compute = count
    before = rms(world.errors())
    link = world.loop(*CLOSED)
    world.connections.foresee(link)
    for _ in range(POLLS + 1):  # a poll of its own is in `foreseeing`
        assert world.connections.collect(world.now) is None
        if not world.connections.foreseeing:
            break
    for submap in world.atlas.submaps.values():  # and the newest places are not quite as they were
        newest = max(submap.keyframes)
        submap.T_submap_kf[newest] = submap.T_submap_kf[newest] @ se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, 0.01])
    assert world.connections.connect_later(link, world.now) is None
    wait(world)
    assert rms(world.errors()) < 0.7 * before
    world.roll_over()
    assert world.atlas.components() == [[0, 1, 2, 3]]
    assert 3 not in world.atlas.placement
    for _ in range(40):
        world.connections.collect(world.now)
    assert 3 in world.atlas.placement, "solved with the rest"
    assert not computed
