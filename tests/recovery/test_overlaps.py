"""Two maps of one lap, joined by a place alone, are tied where they hold the same keyframes."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.atlas.atlas import LinkKind
from dualslam.core.config.settings import Config
from dualslam.core.events import EventKind
from dualslam.core.geometry import sim3
from dualslam.recovery.fusion import link_overlaps
from dualslam.testing.atlas_world import DriftingMap

SHARED = range(60, 75)
ONSET = 72
N = 124


def lap(bend: float = 0.0) -> DriftingMap:
    """Return a lap in two maps: the second was grown back over `SHARED`, and sees again where the first one began.

    `bend`: logarithm of the scale that the second one loses at keyframe 95.
    """
    world = DriftingMap(N, drift=0.3 * DriftingMap(2).drift)
    for k in range(SHARED.stop):
        world.add(k)
    world.record.event(EventKind.FAILED, world.now, 0, suspected_since=ONSET)
    world.begin_anew()
    S_new_old = sim3.exp([0.2, 1.0, 0.1, 3.0, 4.0, 5.0, 0.6])
    for k in range(SHARED.start, N):
        at = world.S_drifted[95]
        S_bend = at @ sim3.from_parts(np.exp(bend), np.eye(3), np.zeros(3)) @ sim3.inverse(at)
        world.add(k, S_new_old @ S_bend if k > 95 else S_new_old)
    world.connections.connect([world.loop((0, 2), (1, N - 2), kind=LinkKind.MERGE)], world.now)
    return world


def link(world: DriftingMap) -> None:
    link_overlaps(world.record, world.connections, Config(), world.atlas.submaps.keys(), world.now)


@pytest.mark.parametrize("bend", [0.0, 0.3])
def test_maps_come_to_lie_right_by_the_keyframes_that_both_hold(bend: float) -> None:
    world = lap(bend)
    before = world.errors()
    link(world)
    after = world.errors()
    joined = world.atlas.links[-1]
    assert joined.kind is LinkKind.RECOVERY
    assert set(joined.keyframes) <= set(range(SHARED.start, ONSET))
    assert after.max() < 0.5 * before.max()


def test_maps_that_reverse_tracking_has_linked_are_not_linked_again() -> None:
    world = lap()
    link(world)
    n_links = len(world.atlas.links)
    link(world)
    assert len(world.atlas.links) == n_links
