"""Bending along the frames of a submap."""

from __future__ import annotations

import numpy as np

from dualslam.atlas.warp import Warp
from dualslam.core.geometry import sim3

RNG = np.random.default_rng(0)
S = sim3.exp(0.1 * RNG.normal(size=(3, 7)))
WARP = Warp(np.array([10, 20, 40]), S)


def test_knots_have_their_own_and_beyond_the_ends_it_stays() -> None:
    np.testing.assert_array_equal(WARP.at([10, 20, 40]), S)
    np.testing.assert_array_equal(WARP.at([-5, 100]), S[[0, 2]])
    alone = Warp(np.array([7]), S[:1])
    np.testing.assert_array_equal(alone.at([0, 7, 9]), S[[0, 0, 0]])


def test_between_two_knots_it_runs_evenly() -> None:
    fifth = WARP.at([24])[0]
    whole = sim3.inverse(S[1]) @ S[2]
    np.testing.assert_allclose(np.linalg.matrix_power(sim3.inverse(S[1]) @ fifth, 5), whole, atol=1e-12)


def test_the_frame_in_which_it_is_written_does_not_matter() -> None:
    G = sim3.exp(RNG.normal(size=7))
    elsewhere = Warp(WARP.index, G @ S @ sim3.inverse(G))
    np.testing.assert_allclose(elsewhere.at([13, 33]), G @ WARP.at([13, 33]) @ sim3.inverse(G), atol=1e-12)


def test_one_after_the_other() -> None:
    later = Warp(np.array([15, 40]), sim3.exp(0.1 * RNG.normal(size=(2, 7))))
    both = later.after(WARP)
    assert both.index.tolist() == [10, 15, 20, 40]
    np.testing.assert_allclose(both.at(both.index), later.at(both.index) @ WARP.at(both.index), atol=1e-12)


def test_nothing_is_exactly_nothing() -> None:
    still = Warp(np.array([0, 10]), np.array([np.eye(4)] * 2))
    np.testing.assert_array_equal(still.at([0, 3, 10]), np.array([np.eye(4)] * 3))
