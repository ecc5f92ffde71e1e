"""All pairs of descriptors at once, and pair by pair: the same to the bit."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.core.interfaces import Frontend
from dualslam.frontends.features.groups import AllPairs, all_distances
from dualslam.frontends.features.orb import OrbFrontend
from dualslam.frontends.features.sift import SiftFrontend


class _PairByPair:
    """A front end that compares pairs alone."""

    def __init__(self, frontend: Frontend) -> None:
        self.distance = frontend.distance


@pytest.mark.parametrize(("frontend", "length"), [(OrbFrontend(), 32), (SiftFrontend(), 128)], ids=["orb", "sift"])
def test_all_distances_are_those_of_the_pairs_to_the_bit(frontend: Frontend, length: int) -> None:
    rng = np.random.default_rng(0)
    a, b = (rng.integers(0, 256, (n, length), dtype=np.uint8) for n in (37, 501))
    b[:3] = a[:3]
    assert isinstance(frontend, AllPairs)
    pair_by_pair = _PairByPair(frontend)
    assert not isinstance(pair_by_pair, AllPairs)
    found = all_distances(frontend, a, b)
    np.testing.assert_array_equal(found, all_distances(pair_by_pair, a, b))  # type: ignore[arg-type]
    assert (np.diag(found) == 0).sum() == 3
