"""The atlas as a solver sees it: keyframes of several submaps, and what is known of the similarities between them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, overload

from dualslam.core.types import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from dualslam.map.submap import Submap


@dataclass(frozen=True, slots=True, eq=False)
class AtlasEdge:
    """A measured similarity between two keyframes, each in its own submap's unit of length."""

    # Rows of `AtlasProblem.S_world_node`.
    first: int
    second: int
    S_first_second: FloatArray  # (4, 4): ``[[s R, t], [0, 1]]``, takes coordinates in the second keyframe to the first
    covariance: FloatArray
    """(7, 7): of xi in ``S_first_second @ exp(xi)``: rotation, translation, log-scale, in the second keyframe's unit.
    """
    kind: str  # ``within`` a submap, or the kind of the connection
    doubtful: bool = False  # where true, and where others contradict it, it may be rejected
    known: bool = False  # whether an earlier solution has believed it


@dataclass(frozen=True, slots=True, eq=False)
class AtlasEdges(Sequence[AtlasEdge]):
    """Many edges, as arrays: each is made when it is asked for. See `AtlasEdge`.

    They go to another process ten times as fast as so many objects.
    """

    first: IntArray  # (E,)
    second: IntArray  # (E,)
    S_first_second: FloatArray  # (E, 4, 4)
    covariance: FloatArray  # (E, 7, 7)
    kind: tuple[str, ...]
    doubtful: BoolArray  # (E,)
    known: BoolArray  # (E,)

    def __len__(self) -> int:
        return len(self.kind)

    def __iter__(self) -> Iterator[AtlasEdge]:
        first, second, doubtful, known = (a.tolist() for a in (self.first, self.second, self.doubtful, self.known))
        return map(AtlasEdge, first, second, self.S_first_second, self.covariance, self.kind, doubtful, known)

    @overload
    def __getitem__(self, at: int) -> AtlasEdge: ...
    @overload
    def __getitem__(self, at: slice) -> tuple[AtlasEdge, ...]: ...
    def __getitem__(self, at: int | slice) -> AtlasEdge | tuple[AtlasEdge, ...]:
        if isinstance(at, slice):
            return tuple(self)[at]
        return AtlasEdge(
            int(self.first[at]),
            int(self.second[at]),
            self.S_first_second[at],
            self.covariance[at],
            self.kind[at],
            bool(self.doubtful[at]),
            bool(self.known[at]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class AtlasProblem:
    """A connected piece of the atlas; plain arrays, so that it can be solved in another process."""

    S_world_node: FloatArray  # (N, 4, 4): initial similarities: keyframe, in its submap's unit, to world
    fixed: int  # the node that stays where it is: the gauge
    edges: Sequence[AtlasEdge]  # connections in the order in which they arrived


@dataclass(frozen=True, slots=True, eq=False)
class AtlasSolution:
    """The optimum of an `AtlasProblem`."""

    S_world_node: FloatArray  # (N, 4, 4)
    believed: BoolArray  # (E,): false for doubtful edges that were rejected
    chi2: FloatArray
    """(E,): of connections against all others that are believed (7 degrees of freedom). NaN if nothing else ties the
    ends, for edges that are no connection, and for all but the newest of many that are not doubtful."""
    # Half the sum of squared whitened residuals of the believed edges.
    cost_before: float
    cost_after: float
    drift: float = 1.0
    """By how much larger than claimed the errors within submaps are, as connections show that are not doubtful; 1 where
    none closes a cycle. All sigmas within submaps have been taken that many times."""


class AtlasSolver(Protocol):
    """Solves graphs over Sim(3), and knows what a submap's own factors say about its inner similarities."""

    def solve(self, problem: AtlasProblem) -> AtlasSolution:
        """Find the similarities that agree best with the edges, without those that are wrong.

        Raises `SolverError`.
        """
        ...

    def relative_covariances(self, problem: AtlasProblem, first: int) -> FloatArray:
        """Return (N, 7, 7) covariances of ``inv(S_world_first) @ S_world_node`` (right perturbation), as solved.

        Raises `SolverError`: also where nothing ties some node to the first.
        """
        ...

    def edge_covariances(
        self, submap: Submap, pairs: Sequence[tuple[int, int]], held: frozenset[int] = frozenset()
    ) -> FloatArray:
        """Return (E, 7, 7) covariances of the similarities between pairs of a submap's keyframes, as its factors say.

        `held`: keyframes whose `Submap.relative_poses` hold an earlier bend, and are no evidence.

        Raises `SolverError`.
        """
        ...

    def refit_points(self, submap: Submap, landmark_ids: IntArray) -> FloatArray:
        """Return (N, 3) some of a submap's landmarks as their views have them by the poses as they are; cannot fail."""
        ...
