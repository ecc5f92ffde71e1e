"""What is remembered of a submap's nodes is what one would find by looking anew, whatever happened to it."""

from __future__ import annotations

import pickle
from collections.abc import Callable

import numpy as np
import pytest

from dualslam.atlas.node_views import NodeView, NodeViews
from dualslam.atlas.skeleton import skeleton_knots
from dualslam.atlas.warp import Warp
from dualslam.core.atlas_problem import AtlasEdge, AtlasEdges
from dualslam.core.geometry import sim3
from dualslam.map.submap import Submap
from dualslam.testing.atlas_world import N_ROUND, DriftingMap


def lap() -> DriftingMap:
    """A lap and a bit in one submap, in which what is seen again is not recognised."""
    world = DriftingMap(N_ROUND + 10)
    for k in range(N_ROUND + 10):
        world.add(k)
    return world


def close(world: DriftingMap) -> None:
    """Make one of what was mapped twice: the ends of the lap see the same landmarks then."""
    submap, k = world.submap, N_ROUND
    first = dict(zip(world.points[0].tolist(), submap.landmark_of[0].tolist(), strict=True))
    again = dict(zip(world.points[k].tolist(), submap.landmark_of[k].tolist(), strict=True))
    both = sorted(first.keys() & again.keys())
    submap.merge_landmarks(np.array([first[p] for p in both]), np.array([again[p] for p in both]))


def lose(world: DriftingMap) -> None:
    obs = world.submap.observations
    world.submap.remove_observations(np.flatnonzero(obs["kf"] == 10)[::2])


def scale(world: DriftingMap) -> None:
    world.submap.transform(2.0, np.eye(4))


def replace_by_a_copy(world: DriftingMap) -> None:
    """As many rows, as many alive, but others."""
    obs = world.submap.observations
    other = world.submap.copy()
    world.submap.remove_observations(np.flatnonzero(obs["kf"] == 10)[:5])
    other.remove_observations(np.flatnonzero(obs["kf"] == 20)[:5])
    NODE_VIEWS(world.submap, skeleton_knots(world.submap), None)
    world.submap.take_over(other)


NODE_VIEWS = NodeViews()


def nothing(world: DriftingMap) -> None:
    pass


def cull_the_newest(world: DriftingMap) -> None:
    k = max(world.submap.keyframes)
    anchor = sorted(world.submap.keyframes)[-2]
    world.submap.remove_keyframe(k, anchor)


@pytest.mark.parametrize("happens", [nothing, close, lose, scale, replace_by_a_copy, cull_the_newest])
@pytest.mark.parametrize("bends", [False, True])
def test_what_is_remembered_is_what_there_is(happens: Callable[[DriftingMap], None], bends: bool) -> None:
    world = lap()
    submap = world.submap
    before = NODE_VIEWS(submap, skeleton_knots(submap), None)
    happens(world)
    warp = Warp(np.array([0, 50]), sim3.exp(0.01 * np.arange(14.0).reshape(2, 7))) if bends else None
    found = NODE_VIEWS(submap, skeleton_knots(submap), warp)
    assert_as_anew(found, submap, warp)
    assert (found is before) == (happens is nothing and not bends)
    assert NODE_VIEWS(submap, skeleton_knots(submap), warp) is found


def assert_as_anew(found: NodeView, submap: Submap, warp: Warp | None) -> None:
    anew = NodeView.of(submap, skeleton_knots(submap), warp)
    assert found.knots == anew.knots
    assert found.places == anew.places
    np.testing.assert_array_equal(found.depth, anew.depth)
    medians = [np.median(submap.landmarks["distance_mu"][ids]) for ids in found.seen]
    np.testing.assert_array_equal(found.depth, medians)
    if warp is None:
        assert found.unbend is None
    else:
        np.testing.assert_allclose(found.unbend @ warp.at(found.knots), [np.eye(4)] * len(found.knots), atol=1e-12)


def test_the_ends_of_a_closed_lap_are_tied() -> None:
    world = lap()
    views, knots = NodeViews(), skeleton_knots(world.submap)
    ends = (knots.index(0), knots.index(N_ROUND))
    assert ends not in views(world.submap, knots, None).places
    close(world)
    assert ends in views(world.submap, knots, None).places


def test_edges_come_out_of_their_arrays_as_they_were() -> None:
    rng = np.random.default_rng(0)
    S, C = rng.normal(size=(3, 4, 4)), rng.normal(size=(3, 7, 7))
    yes = np.array([False, True, True])
    kinds = ("within", "loop", "rollover")
    edges = pickle.loads(
        pickle.dumps(AtlasEdges(np.arange(3), np.arange(1, 4), S, C, kinds, yes, ~yes))  # as it goes to a worker
    )
    assert len(edges) == 3
    for i, edge in enumerate(edges):
        assert isinstance(edge, AtlasEdge)
        assert (edge.first, edge.second, edge.kind) == (i, i + 1, kinds[i])
        assert (edge.doubtful, edge.known) == (bool(yes[i]), not yes[i])
        np.testing.assert_array_equal(edge.S_first_second, S[i])
        np.testing.assert_array_equal(edge.covariance, C[i])
    assert [edge.kind for edge in edges[-2:]] == ["loop", "rollover"]
    assert edges[-1].first == 2
