"""Covariances within submaps: computed beside the tracking where they are foreseen, and otherwise when needed."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from dualslam.atlas.edge_covariances import EdgeCovariances, answer_edges
from dualslam.atlas.warp import Warp
from dualslam.backend.edge_covariance import edge_covariances
from dualslam.core.errors import SolverError
from dualslam.core.geometry import se3, sim3
from dualslam.core.jobs import InlineDesk, JobKind
from dualslam.core.types import FloatArray
from dualslam.map.submap import Submap
from dualslam.testing.atlas_world import DriftingMap
from dualslam.testing.late_desk import LateDesk

PAIRS = list(pairwise([0, 8, 16, 24]))


@pytest.fixture(scope="module")
def submap() -> Submap:
    world = DriftingMap(25)
    for k in range(25):
        world.add(k)
    return world.submap


class Counted:
    """The back end's covariances; `fails`: none at all. Counts the edges that it is asked for."""

    def __init__(self, fails: bool = False) -> None:
        self.n, self.fails = 0, fails

    def __call__(self, submap: Submap, pairs: list[tuple[int, int]], held: frozenset[int]) -> FloatArray:
        self.n += len(pairs)
        if self.fails:
            raise SolverError("no covariance")
        return edge_covariances(submap, pairs, 0.8, held)


def late(compute: Counted, polls: int = 1) -> LateDesk:
    return LateDesk(InlineDesk({JobKind.EDGES: lambda question: answer_edges(question, compute)}), polls)


def test_what_was_foreseen_is_not_computed_again(submap: Submap) -> None:
    here, there = Counted(), Counted()
    covariances = EdgeCovariances(here, late(there))
    covariances.foresee(submap, PAIRS[:2], frozenset())
    assert covariances.foreseeing
    assert not covariances.foreseeing, "one poll later it is there"
    C = covariances(submap, PAIRS, frozenset())
    assert (there.n, here.n) == (2, 1)
    np.testing.assert_array_equal(C, edge_covariances(submap, PAIRS, 0.8))


def test_what_is_not_there_in_time_is_computed_when_it_is_needed(submap: Submap) -> None:
    here = Counted()
    covariances = EdgeCovariances(here, late(Counted(), polls=100))
    covariances.foresee(submap, PAIRS, frozenset())
    np.testing.assert_array_equal(covariances(submap, PAIRS, frozenset()), edge_covariances(submap, PAIRS, 0.8))
    assert here.n == 3


def test_a_question_that_came_to_nothing_costs_no_more_than_its_answer(submap: Submap) -> None:
    here = Counted()
    covariances = EdgeCovariances(here, late(Counted(fails=True), polls=0))
    covariances.foresee(submap, PAIRS, frozenset())
    assert not covariances.foreseeing
    assert np.isfinite(covariances(submap, PAIRS, frozenset())).all()
    assert here.n == 3


def test_an_answer_for_a_map_that_has_moved_meanwhile_is_not_taken(submap: Submap) -> None:
    moved, here = submap.copy(), Counted()
    covariances = EdgeCovariances(here, late(Counted()))
    covariances.foresee(moved, PAIRS[:1], frozenset())
    moved.T_submap_kf[8] = moved.T_submap_kf[8].copy()
    moved.T_submap_kf[8][:3, 3] *= 1.5
    assert covariances.foreseeing
    covariances(moved, PAIRS[:1], frozenset())
    assert here.n == 1


def test_a_submap_that_is_bent_says_the_same_in_its_new_unit(submap: Submap) -> None:
    here = Counted()
    covariances = EdgeCovariances(here, late(Counted()))
    covariances(submap, PAIRS, frozenset())
    scale, T = 1.7, se3.exp([0.3, -0.2, 0.1, 2.0, 0.0, -1.0])
    bent = submap.copy()
    bent.transform(scale, T)
    S = sim3.from_parts(scale, T[:3, :3], T[:3, 3])
    covariances.bent(bent, Warp(np.array([0]), S[None]))
    np.testing.assert_allclose(
        covariances(bent, PAIRS, frozenset()), edge_covariances(bent, PAIRS, 0.8), rtol=1e-3, atol=1e-9
    )
    assert here.n == len(PAIRS), "it is not asked again"
