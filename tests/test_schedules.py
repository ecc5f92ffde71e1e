"""Whatever the schedule of the background work: a run with a loss ends in one right map, and repeats to the bit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from dualslam.atlas.record import FrameStamp
from dualslam.core.jobs import JobKind
from dualslam.core.schedule import DELAYS, After, Policy, Recorded, header_of
from dualslam.core.types import FailureReason
from dualslam.map.submap import Submap
from dualslam.recovery.manager import Recoveries
from dualslam.run.results import trajectories_of
from dualslam.system.system import System
from dualslam.testing.lossy import Lossy
from dualslam.testing.point_world import PointWorld, cloud, hand_held, pose_errors, system_in
from tests.seeds import first_of

COVERED = frozenset(range(24, 34))
N, N_POINTS = 52, 450
POSITION_M, ROTATION_RAD = 0.08, 0.01
SETTINGS = {
    "recovery": {"enabled": True, "workers": 1},
    "keyframes": {"max_parallax_deg": 1.0},
    "mapping": {"redundant_ratio": 1.0},
}
GRAPH, CALIBRATION, WALK = JobKind.GRAPH, JobKind.CALIBRATION, JobKind.WALK
OF_THE_ATLAS = [JobKind.LOOP, JobKind.EDGES, JobKind.ATLAS]


def run(
    schedule: Policy, lossy: Lossy | None = None, covered: frozenset[int] = COVERED, seed: int = 0, n: int = N
) -> tuple[System, PointWorld, Recorded]:
    """A run and its record."""
    world = PointWorld(cloud(N_POINTS), hand_held(n), covered=covered, seed=seed)
    system, rows = system_in(world, schedule, seed=seed, **SETTINGS), list[dict[str, Any]]()
    system.desk.on_record = rows.append
    if lossy is not None:
        system.desk.executor = lossy.around(system.desk.executor)
    for frame in world.frames():
        system.step(frame)
    system.finish()
    return system, world, Recorded.of([header_of(schedule, False), *rows])


def poses_of(system: System) -> tuple[list[int], np.ndarray]:
    main = trajectories_of(system).main
    return main.index.tolist(), main.T_world_cam


def assert_one_right_map(system: System, world: PointWorld) -> None:
    index, T = poses_of(system)
    assert set(index) == set(range(len(world.T_world_cam))) - world.covered
    translation, rotation = pose_errors(T, world.T_world_cam[index])
    assert translation.max() < POSITION_M
    assert rotation.max() < ROTATION_RAD


def assert_repeats(system: System, record: Recorded, **how: Any) -> None:
    again, _, record_again = run(record, **how)
    assert not record.departure
    for mine, theirs in zip(poses_of(again), poses_of(system), strict=True):
        assert np.array_equal(mine, theirs)
    assert record_again.answers == record.answers


def all_after(frames: float) -> After:
    return After(dict.fromkeys(DELAYS, frames))


@pytest.mark.parametrize("schedule", first_of([all_after(5), all_after(math.inf)]), ids=["5", "never"])
def test_a_run_with_a_loss_is_right_under_a_schedule_and_repeats_to_the_bit(schedule: Policy) -> None:
    system, world, record = run(schedule)
    assert_one_right_map(system, world)
    assert_repeats(system, record)


@pytest.mark.slow
@pytest.mark.parametrize("kinds", [[GRAPH], [CALIBRATION], [WALK], OF_THE_ATLAS])
def test_whichever_answers_come_at_the_end_alone(kinds: Sequence[JobKind]) -> None:
    system, world, _ = run(After({**DELAYS, **dict.fromkeys(kinds, math.inf)}))
    assert_one_right_map(system, world)


@pytest.mark.slow
def test_answers_may_come_with_the_next_frame() -> None:
    system, world, _ = run(all_after(0))
    assert_one_right_map(system, world)


@pytest.mark.slow
def test_the_last_walk_begins_from_a_map_that_its_graph_has_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    """A merge before it, at the end of the run, has left the map to its graph (random_schedules.py, seed 507)."""
    systems, behind, retry = [], [], Recoveries.retry

    def noted(recoveries: Recoveries, submap: Submap, now: FrameStamp, last_chance: bool = False) -> None:
        if last_chance:
            behind.extend(graph.is_behind for graph in systems[0]._state.parts.graphs._graphs.values())
        retry(recoveries, submap, now, last_chance)

    monkeypatch.setattr(Recoveries, "retry", noted)
    world = PointWorld(cloud(), hand_held(48), covered=COVERED)
    system = system_in(world, all_after(math.inf), **SETTINGS)
    systems.append(system)
    for frame in world.frames():
        system.step(frame)
    system.finish()
    assert behind
    assert not any(behind)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kinds", "reason"),
    [
        ([GRAPH], FailureReason.TIMEOUT),
        (OF_THE_ATLAS, FailureReason.WORKER),
        ([GRAPH, CALIBRATION], FailureReason.WORKER),
    ],
)
def test_whichever_workers_die_or_hang(kinds: Sequence[JobKind], reason: FailureReason) -> None:
    """Walks are not among them: a link needs one that ends."""
    lossy = Lossy(kinds, every=2, reason=reason)
    system, world, record = run(After(), lossy)
    assert lossy.n_lost
    assert_one_right_map(system, world)
    assert_repeats(system, record)


@pytest.mark.slow
def test_answers_for_maps_that_are_gone() -> None:
    """Three losses, the second map is hardly begun when it is lost; walks end long after their maps."""
    rng = np.random.default_rng(0)
    covered = frozenset({*range(20, 30), *range(42, 52), *range(72, 82)})
    delays = {kind: float(rng.choice([0, 1, 5, 20, 40, math.inf])) for kind in DELAYS}
    lossy = Lossy(list(DELAYS), every=7)
    how = {"covered": covered, "n": 98}
    system, world, record = run(After(delays), lossy, **how)
    for submap in system.atlas.submaps.values():
        assert submap.keyframes.keys() == submap.T_submap_kf.keys() == submap.landmark_of.keys()
    for component in trajectories_of(system).unlinked.values():
        assert np.isfinite(component.T_world_cam).all()
    index, T = poses_of(system)
    translation, _ = pose_errors(T, world.T_world_cam[index])
    assert translation.max() < 2 * POSITION_M
    assert_repeats(system, record, **how)
