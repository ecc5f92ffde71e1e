"""The atlas graph: the similarities that agree best with all connections, and how far odometry is to be believed.

A connection is asked how far it lies from the result of *all others*, against its own covariance and theirs together
(its innovation). The solution itself uses each connection's own covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from dualslam.backend.edge_covariance import edge_covariances
from dualslam.backend.point_refinement import refit_points
from dualslam.backend.sim3_graph import Sim3Edge, Sim3Solution, optimise_sim3
from dualslam.core.atlas_problem import AtlasProblem, AtlasSolution
from dualslam.core.chi_square import MEDIAN_CHI2, squared_distances
from dualslam.core.errors import SolverError
from dualslam.core.geometry import sim3
from dualslam.core.types import FloatArray, IntArray
from dualslam.map.submap import Submap

LEAST_SIGMAS = np.array([1e-4, 1e-4, 1e-4, 5e-4, 5e-4, 5e-4, 5e-4])
"""No connection is taken as surer than this (rad, the second submap's unit, log-scale): pixels of half a pixel at a
focal length of 700 and a few hundred matches. Below, the factor would also be beyond what a double resolves."""
SETTLED_COST = 1e-9
"""A graph with no more than this to gain stands already: a tree, whose nodes were composed along its edges."""
MAX_ITERATIONS = 100
ODOMETRY = ("within", "rollover")
"""Kinds of edges that say how a camera went, and not where it has been before."""
MAX_ASKED = 20
"""Newest connections that are asked how much the odometry has drifted: their median needs no more."""
LEAST_REDUNDANCY = 1e-6
"""Share of an edge's variance below which the rest of the graph has no say in it."""


class GtsamAtlasSolver:
    """The `dualslam.core.atlas_problem.AtlasSolver` made with GTSAM.

    `robust_k`: Huber threshold of the submaps' projections, in sigmas.
    """

    def __init__(self, robust_k: float) -> None:
        self._robust_k = robust_k

    def solve(self, problem: AtlasProblem) -> AtlasSolution:
        """Find the similarities that agree best with the edges.

        Raises `SolverError`.
        """
        graph = _Graph(problem)
        drift, chi2 = graph.take_in_drift()
        solution = graph.optimise()
        found = np.array([solution.S_world_node[i] for i in range(len(problem.S_world_node))])
        return AtlasSolution(found, chi2, solution.cost_before, solution.cost_after, drift)

    def relative_covariances(self, problem: AtlasProblem, first: int) -> FloatArray:
        """Return (N, 7, 7) covariances of ``inv(S_world_first) @ S_world_node``, 0 at the first.

        Raises `SolverError`.
        """
        graph = _Graph(problem)
        label = graph.pieces()
        if (label != label[first]).any():
            raise SolverError("nothing ties some keyframes to the first: they have no relative covariance")
        graph.take_in_drift()
        found = np.zeros((len(label), sim3.DOF, sim3.DOF))
        others = np.delete(np.arange(len(label)), first)
        found[others] = graph.optimise().relative_covariances([(first, n) for n in others.tolist()])
        return found

    def edge_covariances(
        self, submap: Submap, pairs: Sequence[tuple[int, int]], held: frozenset[int] = frozenset()
    ) -> FloatArray:
        """Return (E, 7, 7) covariances of the similarities between pairs of a submap's keyframes.

        `held`: keyframes whose relative pose is no evidence.

        Raises `SolverError`.
        """
        return edge_covariances(submap, pairs, self._robust_k, held)

    def refit_points(self, submap: Submap, landmark_ids: IntArray) -> FloatArray:
        """Return (N, 3) some of a submap's landmarks as their views have them by the poses as they are."""
        return refit_points(submap, self._robust_k, landmark_ids)


class _Graph:
    """A problem whose edges have covariances that a solver can take."""

    def __init__(self, problem: AtlasProblem) -> None:
        self.problem = problem
        least = np.diag(LEAST_SIGMAS**2)
        self.edges = [
            Sim3Edge(e.first, e.second, e.S_first_second, e.covariance + (0 if e.kind == "within" else least))
            for e in problem.edges
        ]
        self.nodes = dict(enumerate(problem.S_world_node))

    def optimise(self) -> Sim3Solution:
        """Solve."""
        held = {self.problem.fixed: self.nodes[self.problem.fixed]}
        return optimise_sim3(self.nodes, self.edges, held, max_iterations=MAX_ITERATIONS, settled_cost=SETTLED_COST)

    def pieces(self, without: int = -1) -> IntArray:
        """Return for each node the piece that it belongs to, the lowest node of it; one edge may be left out."""
        parent = list(range(len(self.nodes)))
        for i, e in enumerate(self.edges):
            if i != without:
                _join(parent, e.first, e.second)
        return np.array([_root(parent, i) for i in range(len(parent))], np.int64)

    def take_in_drift(self) -> tuple[float, FloatArray]:
        """Inflate what submaps say of themselves by what connections show of it.

        Where a connection closes a cycle, the way round has drifted by its innovation: with a lens that is not quite
        right, errors add up as no covariance of pixels says. The lower median of the newest is taken, so that a wrong
        one among them does not make everything seem possible.

        Returns the ratio of sigmas, and the chi-square of those that were asked against all others (NaN: the rest).
        """
        odometry = np.array([e.kind in ODOMETRY for e in self.problem.edges], bool)
        chi2 = np.full(len(self.edges), np.nan)
        newest_first = filter(self._is_on_a_cycle, np.flatnonzero(~odometry)[::-1].tolist())
        tested = np.array([*islice(newest_first, MAX_ASKED)][::-1], np.int64)
        if not len(tested):
            return 1.0, chi2
        C, r = self._innovations(self.optimise(), tested)
        chi2[tested] = squared_distances(r, C)
        ratio2 = max(1.0, float(np.sort(chi2[tested])[(len(tested) - 1) // 2]) / MEDIAN_CHI2[sim3.DOF])
        for i in np.flatnonzero(odometry).tolist():
            self.edges[i] = replace(self.edges[i], covariance=ratio2 * self.edges[i].covariance)
        return float(np.sqrt(ratio2)), chi2

    def _is_on_a_cycle(self, edge: int) -> bool:
        """Whether something else ties the ends of an edge."""
        label = self.pieces(without=edge)
        return bool(label[self.edges[edge].first] == label[self.edges[edge].second])

    def _innovations(self, solution: Sim3Solution, tested: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return covariance (E, 7, 7) and residual (E, 7) of each tested edge against all but itself.

        Both follow from those of the solution (R the edge's covariance, P the solution's of the same similarity): the
        innovation's covariance is ``R inv(R - P) R``, the innovation ``R inv(R - P) r``.
        """
        edges = [self.edges[i] for i in tested.tolist()]
        P = solution.relative_covariances([(e.first, e.second) for e in edges])
        r = solution.residuals(edges)
        C = np.empty_like(P)
        for i, e in enumerate(edges):
            L = np.linalg.cholesky(e.covariance)
            share = np.eye(sim3.DOF) - np.linalg.solve(L, np.linalg.solve(L, P[i]).T)
            values, vectors = np.linalg.eigh((share + share.T) / 2)
            back = vectors / np.maximum(values, LEAST_REDUNDANCY) @ vectors.T
            C[i] = L @ back @ L.T
            r[i] = L @ back @ np.linalg.solve(L, r[i])
        return (C + C.transpose(0, 2, 1)) / 2, r


def _root(parent: list[int], i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


def _join(parent: list[int], a: int, b: int) -> None:
    a, b = _root(parent, a), _root(parent, b)
    parent[max(a, b)] = min(a, b)
