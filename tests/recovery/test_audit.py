"""A matured map tracks in reverse over its start: a right one is confirmed, a wrong one is cut off and re-posed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.core.events import EventKind
from dualslam.core.geometry import se3
from dualslam.core.types import FloatArray, FrameStatus
from dualslam.recovery.audit import split_for_audit, without_start
from dualslam.run.results import frame_rows, trajectories_of
from dualslam.system import System
from dualslam.testing.point_world import PointWorld, cloud, hand_held, path, pose_errors, system_in

POSITION_M, ROTATION_RAD = 0.06, 0.01
ON = {"recovery": {"enabled": True}, "loops": {"enabled": False}, "buffer": {"duration_s": 4.0}}


N_FRAMES = 90


def world() -> PointWorld:
    return PointWorld(cloud(length_m=24.0), path(N_FRAMES, np.array([0.25, 0.0, 0.02]), np.zeros(3)))


def shrunk_start(system: System, factor: float) -> None:
    """Shrink all of the live map that lies before the half which asks, as a start of another scale would."""
    assert system.live is not None
    submap = system.live.submap
    split = split_for_audit(submap)
    T_split = submap.T_submap_kf[split]
    for i, pose in system.poses.items():
        if i < split:
            T_split_cam = se3.inverse(T_split) @ submap.resolve_anchor(pose.keyframe_id, pose.T_kf_cam)
            T_split_cam[:3, 3] *= factor
            system.poses[i] = replace(pose, keyframe_id=split, T_kf_cam=T_split_cam)
    for k in submap.keyframes:
        if k < split:
            submap.T_submap_kf[k][:3, 3] = T_split[:3, 3] + factor * (submap.T_submap_kf[k][:3, 3] - T_split[:3, 3])


def run(world: PointWorld, factor: float = 1.0, **settings: object) -> System:
    system = system_in(world, **(ON | settings))
    for frame in world.frames():
        before = len(system._recoveries._audits.asked)
        system.step(frame)
        if len(system._recoveries._audits.asked) > before and factor != 1.0:
            shrunk_start(system, factor)
    system.finish()
    return system


@pytest.fixture(scope="module")
def way() -> PointWorld:
    return world()


def right(T: FloatArray, way: PointWorld, index: np.ndarray) -> bool:
    translation, rotation = pose_errors(T, way.T_world_cam[index])
    return bool(translation.max() < 2 * POSITION_M and rotation.max() < ROTATION_RAD)


def test_a_right_start_is_confirmed_and_stays_as_it_is(way: PointWorld) -> None:
    audited, plain = run(way), run(way, audit={"enabled": False})
    (event,) = audited.events.of_kind(EventKind.AUDITED)
    assert event.data["verdict"] == "confirmed"
    assert event.data["frames"] > 10
    assert event.data["posed"] == 1.0
    assert not audited.events.of_kind(EventKind.CUT)
    a, b = (trajectories_of(system).main for system in (audited, plain))
    assert np.array_equal(a.T_world_cam, b.T_world_cam)
    assert not plain.events.of_kind(EventKind.AUDITED)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_start_of_another_scale_is_cut_off_and_its_frames_are_posed_anew(way: PointWorld, factor: float) -> None:
    system = run(way, factor)
    (event,) = system.events.of_kind(EventKind.AUDITED)
    assert event.data["verdict"] == "cut"
    (cut,) = system.events.of_kind(EventKind.CUT)
    assert cut.data["reposed"] > 10
    main = trajectories_of(system).main
    assert len(main) >= 0.95 * N_FRAMES
    assert right(main.T_world_cam, way, main.index)
    rows = frame_rows(system, main)
    posed_anew = [row for row in rows if row.status is FrameStatus.BYPASSED]
    assert len(posed_anew) == cut.data["reposed"] + len(cut.data["left"])
    old = system.atlas.submaps[cut.data["old_submap"]]
    assert old.condemned == set(old.keyframes)  # kept, and not to be relied on


def test_the_half_that_asks_holds_nothing_of_the_start() -> None:
    system = system_in(PointWorld(cloud(), hand_held(40)))
    for frame in PointWorld(cloud(), hand_held(40)).frames():
        system.step(frame)
    assert system.live is not None
    whole = system.live.submap
    split = split_for_audit(whole)
    rest = without_start(whole, split)
    assert min(rest.keyframes) == split
    assert set(rest.gauge) <= rest.keyframes.keys()
    alive = np.flatnonzero(rest.landmarks["alive"])
    assert (rest.n_observations(alive) >= 2).all()
    for k in whole.keyframes:  # what stood where it stood still does
        assert np.allclose(rest.resolve_anchor(k, np.eye(4)), whole.T_submap_kf[k])


def test_a_map_that_has_lost_the_keyframe_it_is_split_at_is_left_as_it_is(way: PointWorld) -> None:
    """The walk is made beside the run, which goes on culling."""
    system = system_in(way, **ON)
    for frame in way.frames():
        before = len(system._recoveries._audits.asked)
        system.step(frame)
        if len(system._recoveries._audits.asked) > before:
            break
    assert system.live is not None
    submap = system.live.submap
    submap.remove_keyframe(split_for_audit(submap), max(submap.keyframes))
    system.finish()
    (event,) = system.events.of_kind(EventKind.AUDITED)
    assert (event.data["verdict"], event.data["detail"]) == ("undecided", "the map has changed meanwhile")
    assert not system.events.of_kind(EventKind.CUT)
