"""The real system on a lap: it is lost and recovers, rolls over, and a loop is closed while it goes on."""

from __future__ import annotations

from functools import cache

import numpy as np

from dualslam.atlas.atlas import Link, LinkKind
from dualslam.atlas.report import AtlasReport
from dualslam.atlas.trajectory import compose
from dualslam.backend.atlas_solver import GtsamAtlasSolver
from dualslam.core.events import EventKind
from dualslam.core.geometry import se3, sim3
from dualslam.core.types import FloatArray
from dualslam.system.system import System
from dualslam.testing.atlas_world import LINK_SIGMAS, align, fit_similarity
from dualslam.testing.point_world import PointWorld, system_in

N_LAP, N = 150, 185
RADIUS_M = 7.0
COVERED = range(85, 93)
CLOSED_AT = 168


def lap() -> PointWorld:
    """A camera on a circle that looks outwards, points all around."""
    rng = np.random.default_rng(0)
    a = rng.uniform(0, 2 * np.pi, 2600)
    r = RADIUS_M + rng.uniform(3.0, 9.0, len(a))
    xyz = np.column_stack([r * np.cos(a), rng.uniform(-4, 4, len(a)), r * np.sin(a)])
    angle = 2 * np.pi * np.arange(N) / N_LAP
    out = np.column_stack([np.cos(angle), 0 * angle, np.sin(angle)])
    down = np.broadcast_to([0.0, 1.0, 0.0], out.shape)
    T = se3.from_parts(np.stack([np.cross(down, out), down, out], axis=2), RADIUS_M * out)
    return PointWorld(xyz, T, covered=frozenset(COVERED))


@cache
def driven() -> tuple[System, PointWorld, AtlasReport, list[float]]:
    """Drive, close the loop at a frame, and drive on; returns the errors before and after it and at the end."""
    world = lap()
    system = system_in(
        world,
        graph={"max_keyframes": 30, "rollover_keyframes": 8},
        recovery={"enabled": True},
        loops={"enabled": False},  # the one that is closed here is the only one
    )
    errors, report = [], None
    for frame in world.frames():
        system.step(frame)
        if frame.index == CLOSED_AT:
            errors.append(ate(system, world))
            link = loop_of_pixels(system, world)
            report = system._connections.connect([link], frame)
            errors.append(ate(system, world))
    errors.append(ate(system, world))
    system.finish()
    assert report is not None
    return system, world, report, errors


def ate(system: System, world: PointWorld) -> float:
    component = max(system.atlas.components(), key=len)
    found = compose(system.poses.values(), system.atlas, system.atlas.S_world_submap(component))
    truth = world.T_world_cam[found.index][:, :3, 3]
    return float(np.sqrt(((align(found.T_world_cam[:, :3, 3], truth) - truth) ** 2).sum(1).mean()))


def loop_of_pixels(system: System, world: PointWorld) -> Link:
    """What the live submap sees of the first one: landmarks with the same descriptor, and their similarity."""
    assert system.live is not None
    live, first = system.live.submap, system.atlas.submaps[0]
    newest = max(live.keyframes)
    seen = live.landmark_of[newest][live.landmark_of[newest] >= 0]
    words = [submap.landmarks["descriptor"] for submap in (live, first)]
    alive = np.flatnonzero(first.landmarks["alive"])
    far = np.bitwise_count(words[0][seen][:, None] ^ words[1][alive][None]).sum(2)
    j = far.argmin(1)
    same = far.min(1) < 60
    assert same.sum() > 30
    p, q = first.landmarks["xyz_mu"][alive[j[same]]], live.landmarks["xyz_mu"][seen[same]]
    for _ in range(5):  # points that are badly known do not count
        S = fit_similarity(q, p)
        off = np.linalg.norm(sim3.act(S, q) - p, axis=1)
        p, q = (x[off <= np.quantile(off, 0.9)] for x in (p, q))
    there = np.array(sorted(first.keyframes))
    nearest = there[np.abs(there - (newest - N_LAP)).argmin()]
    T_b = live.T_submap_kf[newest]
    S_ka_kb = se3.inverse(first.T_submap_kf[int(nearest)]) @ S @ T_b
    covariance = np.diag(LINK_SIGMAS**2)
    return Link.of_keyframes(system.atlas, (0, int(nearest)), (live.id, newest), S_ka_kb, covariance, LinkKind.LOOP)


def test_a_live_run_recovers_rolls_over_and_closes_a_loop() -> None:
    system, _, report, (before, closed, end) = driven()
    print(f"loop: {report.factors}, cost {report.cost_before:.4g} -> {report.cost_after:.4g}, bent {report.bent}")
    print(f"  ATE {before:.4f} -> {closed:.4f} m, at the end {end:.4f} m")
    kinds = [link.kind for link in system.atlas.links]
    assert LinkKind.RECOVERY in kinds
    assert LinkKind.ROLLOVER in kinds
    assert report.factors["loop"] == 1
    assert report.factors["recovery"] == 1
    assert report.cost_after < 0.05 * report.cost_before
    assert closed < 0.7 * before
    assert end < 0.8 * before
    # Tracking goes on as if nothing had happened.
    lost = [i for i, row in system.rows.items() if i > CLOSED_AT and i not in system.poses]
    assert not lost
    assert len(system.events.of_kind(EventKind.FAILED)) == 1
    assert len(system.atlas.components()) == 1


def contradict(system: System, off: FloatArray) -> AtlasReport:
    """Connect the first and the last submap by what is false, and sure of itself."""
    last = max(system.atlas.submaps)
    a, b = (0, sorted(system.atlas.submaps[0].keyframes)[10]), (last, max(system.atlas.submaps[last].keyframes))
    S_world = system.atlas.S_world_submap(system.atlas.component_of(last))
    S_world_ka, S_world_kb = (S_world[m] @ system.atlas.submaps[m].T_submap_kf[k] for m, k in (a, b))
    C = np.diag(np.full(7, 1e-18))
    link = Link.of_keyframes(
        system.atlas, a, b, sim3.inverse(S_world_ka) @ S_world_kb @ sim3.exp(off), C, LinkKind.LOOP
    )
    return system._connections.connect([link], list(system.rows.values())[-1])


def test_a_contradiction_with_a_tiny_sigma_moves_the_maps_where_all_are_obeyed_and_else_nothing() -> None:
    off = np.array([0.0, 0.3, 0.0, 1.0, 0.0, 0.5, 0.4])
    system, world, _, _ = driven()
    for robust in (True, False):
        system._connections._solver = GtsamAtlasSolver(robust, 0.8)
        before = ate(system, world)
        poses = [submap.keyframe_poses(sorted(submap.keyframes)) for submap in system.atlas.submaps.values()]
        report = contradict(system, off)
        now = [submap.keyframe_poses(sorted(submap.keyframes)) for submap in system.atlas.submaps.values()]
        moved = max(float(np.abs(a - b).max()) for a, b in zip(poses, now, strict=True))
        print(f"GNC {robust}: {report.factors}, cost {report.cost_before:.4g} -> {report.cost_after:.4g}")
        print(f"  moved {moved:.3g}, ATE {before:.4f} -> {ate(system, world):.4f} m")
        if robust:
            assert len(report.rejected) == 1
            assert moved == 0
            assert ate(system, world) == before
        else:
            assert not report.rejected
            assert moved > 0.05
            assert ate(system, world) > 2 * before
