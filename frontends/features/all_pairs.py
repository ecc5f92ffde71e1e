"""Distances of all descriptors to all others, in the quickest way that a front end has."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from dualslam.core.interfaces import Frontend
from dualslam.core.types import FloatArray


@runtime_checkable
class AllPairs(Protocol):
    """A front end that compares all with all in less time than pair by pair."""

    def distances(self, a: NDArray[np.generic], b: NDArray[np.generic]) -> FloatArray:
        """Distances of descriptors (N, D), (M, D) -> (N, M), each to the bit what `Frontend.distance` says."""
        ...


def all_distances(frontend: Frontend, a: NDArray[np.generic], b: NDArray[np.generic]) -> FloatArray:
    """Return the distances (N, M) of descriptors (N, D) to others (M, D), N > 0."""
    if isinstance(frontend, AllPairs):
        return frontend.distances(a, b)
    return np.stack([frontend.distance(np.broadcast_to(row, b.shape), b) for row in a])
