"""Views of a submap's nodes: which of them are tied, and how deep the scene is. Cached until it changes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from dualslam.atlas.warp import Warp
from dualslam.core.geometry import sim3
from dualslam.core.types import FloatArray, IntArray
from dualslam.map.submap import Submap
from dualslam.map.tables import Table

MIN_SHARED, MAX_ACROSS = 30, 2
"""Landmarks that two nodes which are no neighbours share at least to be tied; so many such ties a node looks for."""


@dataclass(frozen=True, slots=True, eq=False)
class NodeView:
    """Cached views of a submap's nodes, and the state of the submap for which they hold."""

    knots: list[int]  # keyframes, ascending
    # Rows of one table are appended, and die; none is changed otherwise: their numbers tell its state.
    observations: Table
    n_rows: int
    n_alive: int
    seen: list[IntArray]  # list of (L,) int64: landmarks that each node sees
    across: list[tuple[int, int]]
    """list of (int, int): places among the nodes of those that are tied though no neighbours."""
    # Of all landmarks; their median where each node sees any, else 1.
    distance_mu: FloatArray  # (M,), (K,) float64
    depth: FloatArray  # (M,), (K,) float64
    # How solutions have bent the submap; what takes that out of its nodes.
    warp: Warp | None  # Warp or None, (K, 4, 4)
    unbend: FloatArray | None  # Warp or None, (K, 4, 4)

    @classmethod
    def of(cls, submap: Submap, knots: list[int], warp: Warp | None) -> NodeView:
        """Look at a submap."""
        seen = [submap.seen_in(k) for k in knots]
        distance_mu = submap.landmarks["distance_mu"].copy()
        obs = submap.observations
        return cls(
            knots,
            obs,
            len(obs),
            int(np.count_nonzero(obs["alive"])),
            seen,
            _across(seen, len(submap.landmarks)),
            distance_mu,
            _depths(distance_mu, seen),
            warp,
            _unbend(warp, knots),
        )

    def now(self, submap: Submap, knots: list[int], warp: Warp | None) -> NodeView:
        """Return what holds now: itself, if nothing has changed."""
        obs, distance_mu = submap.observations, submap.landmarks["distance_mu"]
        if self.knots != knots or obs is not self.observations or len(obs) != self.n_rows:
            return self.of(submap, knots, warp)
        if np.count_nonzero(obs["alive"]) != self.n_alive:
            return self.of(submap, knots, warp)
        view = self
        if warp is not self.warp:
            view = replace(view, warp=warp, unbend=_unbend(warp, knots))
        if not np.array_equal(distance_mu, self.distance_mu):
            view = replace(view, distance_mu=distance_mu.copy(), depth=_depths(distance_mu, self.seen))
        return view

    @property
    def places(self) -> list[tuple[int, int]]:
        """Which nodes are tied, by their places among them: the neighbours first."""
        return [*pairwise(range(len(self.knots))), *self.across]

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """The same by their keyframes."""
        return [(self.knots[i], self.knots[j]) for i, j in self.places]


class NodeViews:
    """Remembers the last `NodeView` of each submap."""

    def __init__(self) -> None:
        self._known: dict[int, NodeView] = {}

    def __call__(self, submap: Submap, knots: list[int], warp: Warp | None) -> NodeView:
        """Return what holds now."""
        known = self._known.get(submap.id)
        view = NodeView.of(submap, knots, warp) if known is None else known.now(submap, knots, warp)
        self._known[submap.id] = view
        return view


def _across(seen: list[IntArray], n_landmarks: int) -> list[tuple[int, int]]:
    """Return pairs of nodes that are no neighbours and yet see the same landmarks."""
    any_sees = np.zeros(n_landmarks, bool)
    any_sees[np.concatenate(seen)] = True
    column = np.cumsum(any_sees) - 1
    sees = np.zeros((len(seen), np.count_nonzero(any_sees)), np.float32)
    for i, ids in enumerate(seen):
        sees[i, column[ids]] = 1
    shared = sees @ sees.T
    place = np.arange(len(seen))
    shared[np.abs(place[:, None] - place) <= 1] = 0
    found: set[tuple[int, int]] = set()
    for i, row in enumerate(shared):
        best = np.argsort(-row, kind="stable")[:MAX_ACROSS]
        found |= {(min(i, j), max(i, j)) for j in best[row[best] >= MIN_SHARED].tolist()}
    return sorted(found)


def _depths(distance_mu: FloatArray, seen: list[IntArray]) -> FloatArray:
    """Return the medians (K,); for so many short rows, `np.median` takes five times as long."""
    depth = np.ones(len(seen))
    for i, ids in enumerate(seen):
        if n := len(ids):
            distances = distance_mu[ids]
            distances.sort()
            depth[i] = distances[n // 2] if n % 2 else (distances[n // 2 - 1] + distances[n // 2]) / 2
    return depth


def _unbend(warp: Warp | None, knots: list[int]) -> FloatArray | None:
    return None if warp is None else sim3.inverse(warp.at(knots))
