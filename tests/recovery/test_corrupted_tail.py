"""A map that goes wrong before it is lost: what the real system suspects, links and by-passes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.atlas.atlas import Link, LinkKind
from dualslam.core.config.corruption import Corruption, CorruptionKind
from dualslam.core.events import EventKind
from dualslam.core.types import FrameStatus
from dualslam.lab.audits.link_audit import LinkAudit, audit_link, audit_links
from dualslam.lab.disturbances import FaultScript
from dualslam.run.results import trajectories_of
from dualslam.system.system import System
from dualslam.testing.point_world import PointWorld, cloud, hand_held, pose_errors, system_in

FORCED = range(34, 40)
COVERED = frozenset(range(40, 54))
N = 84
POSITION_M, ROTATION_RAD = 0.12, 0.02


def run(degrees: float, seed: int) -> tuple[System, PointWorld]:
    """Force a wrong pose into the map in each of the last frames before the lens is covered."""
    world = PointWorld(cloud(), hand_held(N), covered=COVERED)
    # All points stay in view here, and few keyframes are needed; a link stands on four healthy ones at least.
    many = {"keyframes": {"max_parallax_deg": 2.0}, "mapping": {"redundant_ratio": 1.0}}
    # And the map takes in whatever pose it is told, or there would be no corrupted tail.
    system = system_in(world, recovery={"enabled": True}, health={"max_refused": 1.0}, **many)
    fault = Corruption(
        kind=CorruptionKind.WRONG_POSE, start=FORCED.start, length=len(FORCED), strength=degrees, seed=seed
    )
    faults, parts = FaultScript([fault]), system._state.parts
    system._state.parts = replace(
        parts, view_of=faults.around_views(parts.view_of), new_odometry=faults.around_odometry(parts.new_odometry)
    )
    for frame in world.frames():
        system.step(frame)
    system.finish()
    return system, world


@pytest.fixture(
    scope="module", params=[(6.0, 1), pytest.param((15.0, 2), marks=pytest.mark.slow)], ids=["6 deg", "15 deg"]
)
def corrupted(request: pytest.FixtureRequest) -> tuple[System, PointWorld]:
    return run(*request.param)


def recovery_link(system: System) -> Link:
    (link,) = (link for link in system.atlas.links if link.kind is LinkKind.RECOVERY)
    return link


def test_the_link_stands_on_what_was_healthy_and_is_true(corrupted: tuple[System, PointWorld]) -> None:
    system, world = corrupted
    (found,) = audit_links(system.atlas, system.poses.values(), dict(enumerate(world.T_world_cam)))
    assert isinstance(found, LinkAudit)
    assert not found.wrong, found
    assert max(recovery_link(system).keyframes) < FORCED.start


def test_a_place_that_confirms_the_link_is_healthy_and_true(corrupted: tuple[System, PointWorld]) -> None:
    system, world = corrupted
    (loop,) = (link for link in system.atlas.links if link.kind is not LinkKind.RECOVERY)
    assert loop.kind is LinkKind.LOOP
    assert loop.keyframe_a < FORCED.start
    asked = replace(loop, keyframes=recovery_link(system).keyframes)
    found = audit_link(system.atlas, asked, list(system.poses.values()), dict(enumerate(world.T_world_cam)))
    assert isinstance(found, LinkAudit)
    assert not found.wrong, found


def test_what_is_not_to_be_relied_on_is_marked(corrupted: tuple[System, PointWorld]) -> None:
    system, _ = corrupted
    link = recovery_link(system)
    old, new = system.atlas.submaps[link.a], system.atlas.submaps[link.b]
    forced = {k for k in FORCED if k in old.keyframes}
    assert forced <= old.condemned
    assert old.condemned.isdisjoint(link.keyframes)
    assert not new.condemned
    marked = old.landmarks["condemned"]
    healthy = old.landmarks_of_keyframes([k for k in old.keyframes if k not in old.condemned])
    assert len(healthy)
    assert not marked[healthy].any()
    (fused,) = system.events.of_kind(EventKind.FUSED)
    assert fused.data["condemned_keyframes"] == len(old.condemned)
    assert fused.data["condemned_landmarks"] == marked.sum()


def test_the_onset_is_suspected_before_the_loss(corrupted: tuple[System, PointWorld]) -> None:
    system, _ = corrupted
    failed = system.events.of_kind(EventKind.FAILED)[0]
    assert FORCED.start - 2 <= failed.data["suspected_since"] <= FORCED.start + 2
    assert failed.data["suspected_since"] < failed.data["lost_since"]
    assert failed.data["signs"]


def test_the_corrupted_frames_are_bypassed_and_no_pose_is_wrong(corrupted: tuple[System, PointWorld]) -> None:
    system, world = corrupted
    assert all(system.poses[i].submap_id == 1 for i in FORCED if i in system.poses)
    assert FrameStatus.BYPASSED in {system.rows[i].status for i in FORCED}
    main = trajectories_of(system).main
    assert set(range(N)) - COVERED - set(FORCED) <= set(main.index.tolist())
    translation, rotation = pose_errors(main.T_world_cam, world.T_world_cam[main.index])
    assert translation.max() < POSITION_M
    assert np.median(rotation) < ROTATION_RAD
