"""What a live consumer is told: where each frame's submap lies in its world, which moves with events alone."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from dualslam.atlas.atlas import Atlas, Link, LinkKind
from dualslam.atlas.trajectory import Worlds
from dualslam.core.events import EventKind
from dualslam.core.geometry import sim3
from dualslam.map.frame_records import FrameResult
from dualslam.map.submap import Submap
from dualslam.system.system import System
from dualslam.testing.point_world import PointWorld, system_in
from tests.places.worlds import N_LAP, N, lap, ring

TOLD = {EventKind.ROLLED_OVER, EventKind.ATLAS_SOLVED, EventKind.LOOP_CLOSED, EventKind.MERGED, EventKind.LINKED}


def followed(world: PointWorld, **settings: object) -> tuple[System, list[FrameResult]]:
    system = system_in(world, **settings)
    return system, [system.step(frame) for frame in world.frames()]


def test_poses_in_the_world_move_as_the_camera_does_but_for_events() -> None:
    """A lap in submaps that roll over, and a loop that takes its drift back."""
    system, results = followed(lap(), graph={"max_keyframes": 25, "rollover_keyframes": 6})
    assert system.events.of_kind(EventKind.LOOP_CLOSED, EventKind.MERGED)
    told = {event.frame for event in system.events if event.event in TOLD}
    posed = [r for r in results if r.T_world_cam is not None]
    assert len({r.submap_id for r in posed}) > 2
    assert {r.world_id for r in posed} == {0}
    centre = {r.index: r.T_world_cam[:3, 3] for r in posed if r.T_world_cam is not None}
    place = {r.index: (r.submap_id, r.S_world_submap) for r in posed}
    true = ring(N)[:, :3, 3]
    unit = np.median([np.linalg.norm(centre[i] - centre[i - 1]) for i in centre if i - 1 in centre])
    unit /= np.linalg.norm(true[1] - true[0])
    for i in centre:
        if i - 1 not in centre or i in told:
            continue
        step = np.linalg.norm(centre[i] - centre[i - 1]) / unit
        assert abs(step - np.linalg.norm(true[i] - true[i - 1])) < 0.1, f"frame {i} jumps without an event"
        if place[i][0] == place[i - 1][0]:
            assert np.array_equal(place[i][1], place[i - 1][1])  # type: ignore[arg-type]


def test_a_map_that_is_not_joined_is_a_world_of_its_own_until_it_is() -> None:
    covered = frozenset(range(40, 52))
    system, results = followed(lap(n=N_LAP + 20, covered=covered), recovery={"attempts": ["live"]})
    (merged,) = system.events.of_kind(EventKind.MERGED)
    posed = [r for r in results if r.world_id is not None]
    changes = [(a.world_id, b.world_id, b.index) for a, b in pairwise(posed) if a.world_id != b.world_id]
    assert changes == [(0, 1, 54), (1, 0, merged.frame)]


def test_the_world_of_a_saved_map_stays_its_own_and_what_has_not_changed_is_not_made_again() -> None:
    atlas = Atlas()
    for m in range(3):
        atlas.add(Submap(m, np.eye(3), np.zeros(32, np.uint8)))
    S = sim3.exp(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0, 0.5]))
    worlds = Worlds(atlas, saved=1)
    assert [worlds.of(m)[1] for m in range(3)] == [0, 1, 2]
    atlas.link(Link(0, 1, S, np.eye(7), LinkKind.MERGE))
    assert [worlds.of(m)[1] for m in range(3)] == [1, 1, 2]
    assert np.allclose(worlds.of(0)[0], sim3.inverse(S))
    assert np.allclose(worlds.of(1)[0], np.eye(4))
    assert worlds.of(0)[0] is worlds.of(0)[0]


def test_beyond_a_link_that_hardly_knows_its_scale_a_map_is_not_sure_until_the_link_is_tightened() -> None:
    atlas = Atlas()
    for m in range(3):
        atlas.add(Submap(m, np.eye(3), np.zeros(32, np.uint8)))
    worlds = Worlds(atlas, saved=1)
    assert all(worlds.is_sure(m) for m in range(3))  # each in its own unit
    for a, b, is_sure in ((0, 1, False), (1, 2, True)):
        atlas.link(Link(a, b, np.eye(4), np.eye(7), LinkKind.RECOVERY, is_sure=is_sure))
    assert [worlds.is_sure(m) for m in range(3)] == [False, True, True]  # the world is that of submap 1
    atlas.links[0] = replace(atlas.links[0], is_sure=True)
    assert all(worlds.is_sure(m) for m in range(3))
