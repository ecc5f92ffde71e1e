"""The atlas graph: which connections to believe, and the similarities that agree best with those.

Graduated non-convexity (`gtsam.GncLMOptimizer`) starts from the least-squares solution, which a false connection with a
tiny sigma has bent to itself: taken at its word, it wins. The decision therefore uses the innovation: how far a
connection lies from the result of *all others*, against its own covariance and theirs together. A tiny sigma then
counts for nothing, and a true loop after much known drift is not refused. The solution itself uses each connection's
own covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dualslam.backend.edge_covariance import edge_covariances
from dualslam.backend.point_refinement import refit_points
from dualslam.backend.sim3_graph import Sim3Edge, Sim3Solution, optimise_sim3
from dualslam.core.atlas_problem import AtlasProblem, AtlasSolution
from dualslam.core.chi_square import CHI2_99, MEDIAN_CHI2, squared_distances
from dualslam.core.errors import SolverError
from dualslam.core.geometry import sim3
from dualslam.core.types import BoolArray, FloatArray, IntArray
from dualslam.map.submap import Submap

LEAST_SIGMAS = np.array([1e-4, 1e-4, 1e-4, 5e-4, 5e-4, 5e-4, 5e-4])
"""No connection is taken as surer than this (rad, the second submap's unit, log-scale): pixels of half a pixel at a
focal length of 700 and a few hundred matches. Below, the factor would also be beyond what a double resolves."""
SETTLED_COST = 1e-9
"""A graph with no more than this to gain stands already: a tree, whose nodes were composed along its edges."""
MAX_PASSES = 4
"""Rounds of rejection: accepted edges change the tests of the others. Two sufficed in every trial."""
MAX_ITERATIONS = 100
ODOMETRY = ("within", "rollover")
"""Kinds of edges that say how a camera went, and not where it has been before."""
REJECTION_CHI2 = CHI2_99[7]
"""The price of a rejection: an edge has 7 degrees of freedom."""
MAX_ASKED = 20
"""Newest sure connections that are asked how much the odometry has drifted: their median needs no more."""
LEAST_REDUNDANCY = 1e-6
"""Share of an edge's variance below which the rest of the graph has no say in it."""


class GtsamAtlasSolver:
    """The `dualslam.core.atlas_problem.AtlasSolver` made with GTSAM.

    - `robust`: let graduated non-convexity choose among doubtful connections; else all are obeyed.
    - `robust_k`: Huber threshold of the submaps' projections, in sigmas.
    """

    def __init__(self, robust: bool, robust_k: float) -> None:
        self._robust = robust
        self._robust_k = robust_k

    def solve(self, problem: AtlasProblem) -> AtlasSolution:
        """Find the similarities that agree best with the edges, without those that are wrong.

        Raises `SolverError`.
        """
        graph = _Graph(problem)
        doubtful = np.array([e.doubtful for e in problem.edges], bool)
        drift, chi2 = graph.take_in_drift(doubtful)
        believed = np.ones(len(problem.edges), bool)
        if self._robust and doubtful.any():
            believed, of_doubtful = graph.choose(doubtful)
            chi2 = np.where(doubtful, of_doubtful, chi2)
        solution = graph.optimise(believed)
        found = np.array([solution.S_world_node[i] for i in range(len(problem.S_world_node))])
        return AtlasSolution(found, believed, chi2, solution.cost_before, solution.cost_after, drift)

    def relative_covariances(self, problem: AtlasProblem, first: int) -> FloatArray:
        """Return (N, 7, 7) covariances of ``inv(S_world_first) @ S_world_node``, all edges believed; 0 at the first.

        Raises `SolverError`.
        """
        graph = _Graph(problem)
        everything = np.ones(len(problem.edges), bool)
        label = graph.pieces(everything)
        if (label != label[first]).any():
            raise SolverError("nothing ties some keyframes to the first: they have no relative covariance")
        graph.take_in_drift(np.array([e.doubtful for e in problem.edges], bool))
        found = np.zeros((len(label), sim3.DOF, sim3.DOF))
        others = np.delete(np.arange(len(label)), first)
        found[others] = graph.optimise(everything).relative_covariances([(first, n) for n in others.tolist()])
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


@dataclass(frozen=True, slots=True, eq=False)
class _Choice:
    """Accepted edges, the chi-square of the tested ones, and the cost: residuals, and a price per rejection."""

    believed: BoolArray
    chi2: FloatArray
    objective: float


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

    def optimise(self, believed: BoolArray, nodes: dict[int, FloatArray] | None = None) -> Sim3Solution:
        """Solve with the believed edges alone; what nothing ties to the rest stays where it is."""
        chosen = [e for e, kept in zip(self.edges, believed.tolist(), strict=True) if kept]
        start = self.nodes if nodes is None else nodes
        fixed = self.problem.fixed
        held = {fixed: self.nodes[fixed]}
        return optimise_sim3(start, chosen, held, max_iterations=MAX_ITERATIONS, settled_cost=SETTLED_COST)

    def pieces(self, kept: BoolArray) -> IntArray:
        """Return for each node the piece that it belongs to: the lowest node of it."""
        parent = list(range(len(self.nodes)))
        for e, here in zip(self.edges, kept.tolist(), strict=True):
            if here:
                _join(parent, e.first, e.second)
        return np.array([_root(parent, i) for i in range(len(parent))], np.int64)

    # --- how far odometry is to be believed

    def take_in_drift(self, doubtful: BoolArray) -> tuple[float, FloatArray]:
        """Inflate what submaps say of themselves by what sure connections show of it.

        Where a connection that is beyond doubt closes a cycle, the way round has drifted by its innovation: with a lens
        that is not quite right, errors add up as no covariance of pixels says. The lower median of such connections is
        taken, so that a wrong one among them does not make everything seem possible.

        Returns the ratio of sigmas, and the chi-square of those that were asked against all others (NaN: the rest).
        """
        odometry = np.array([e.kind in ODOMETRY for e in self.problem.edges], bool)
        sure = ~odometry & ~doubtful
        believed = ~doubtful | self._base(doubtful)
        chi2 = np.full(len(doubtful), np.nan)
        tested = np.flatnonzero(sure & ~self._bridges(believed, sure))[-MAX_ASKED:]
        if not len(tested):
            return 1.0, chi2
        C, r = self._innovations(self.optimise(believed), believed, tested)
        chi2[tested] = squared_distances(r, C)
        ratio2 = max(1.0, float(np.sort(chi2[tested])[(len(tested) - 1) // 2]) / MEDIAN_CHI2[sim3.DOF])
        for i in np.flatnonzero(odometry).tolist():
            self.edges[i] = replace(self.edges[i], covariance=ratio2 * self.edges[i].covariance)
        return float(np.sqrt(ratio2)), chi2

    # --- what to believe

    def choose(self, doubtful: BoolArray) -> tuple[BoolArray, FloatArray]:
        """Return which edges are believed, and the chi-square of the doubtful ones against the rest (NaN: no rest)."""
        if not (doubtful & ~self._bridges(np.ones(len(doubtful), bool), doubtful)).any():
            return np.ones(len(doubtful), bool), np.full(len(doubtful), np.nan)
        found = self._settle(~doubtful | self._base(doubtful), doubtful)
        for accused in self._accused(found.believed, doubtful):
            without = found.believed.copy()
            without[accused] = False
            other = self._settle(self._connected(without, doubtful, last=accused), doubtful)
            if other.objective < found.objective - 0.5 * REJECTION_CHI2:
                found = other
        return found.believed, found.chi2

    def _settle(self, believed: BoolArray, doubtful: BoolArray) -> _Choice:
        """Ask all that can be asked, from what is believed now, until it stays the same."""
        chi2 = np.full(len(self.edges), np.nan)
        for _ in range(MAX_PASSES):
            solution = self.optimise(believed)
            tested = np.flatnonzero(doubtful & ~self._bridges(believed, doubtful))
            C, r = self._innovations(solution, believed, tested)
            chi2[:] = np.nan
            chi2[tested] = squared_distances(r, C)
            after = self._connected(self._graduate(solution, tested, C), doubtful)
            if (after == believed).all():
                break
            believed = after
        cost = self.optimise(believed).cost_after
        return _Choice(believed, chi2, cost + 0.5 * REJECTION_CHI2 * np.count_nonzero(~believed))

    def _accused(self, believed: BoolArray, doubtful: BoolArray) -> list[int]:
        """Return the believed edges that two or more rejected ones would do without: one of them may be wrong."""
        rejected = np.flatnonzero(~believed).tolist()
        found = []
        for i in np.flatnonzero(believed & doubtful).tolist() if len(rejected) > 1 else ():
            rest = believed.copy()
            rest[i] = False
            label = self.pieces(rest)
            if sum(label[self.edges[j].first] != label[self.edges[j].second] for j in rejected) > 1:
                found.append(i)
        return found

    def _base(self, doubtful: BoolArray) -> BoolArray:
        """Return the doubtful edges that are believed to begin with: those that were, and what it takes to connect."""
        known = np.array([e.known for e in self.problem.edges], bool)
        return self._connected(~doubtful | known, doubtful) & doubtful

    def _connected(self, believed: BoolArray, doubtful: BoolArray, last: int = -1) -> BoolArray:
        """Take back in what is needed so that no part of the graph hangs loose: what arrived first, but `last` last."""
        believed = believed | ~doubtful
        parent = list(range(len(self.nodes)))
        others = sorted(np.flatnonzero(~believed).tolist(), key=lambda i: (i == last, i))
        for i in (*np.flatnonzero(believed).tolist(), *others):
            e = self.edges[i]
            believed[i] |= _join(parent, e.first, e.second)
        return believed

    def _bridges(self, believed: BoolArray, doubtful: BoolArray) -> BoolArray:
        """Return the doubtful edges that alone tie two parts of the believed graph: nothing can contradict them."""
        sure = self.pieces(believed & ~doubtful)
        among = np.flatnonzero(believed & doubtful).tolist()
        bridges = np.zeros(len(believed), bool)
        for i in among:
            parent = list(range(len(self.nodes)))
            for j in among:
                if j != i:
                    _join(parent, int(sure[self.edges[j].first]), int(sure[self.edges[j].second]))
            ends = (int(sure[n]) for n in (self.edges[i].first, self.edges[i].second))
            a, b = (_root(parent, n) for n in ends)
            bridges[i] = a != b
        return bridges

    def _innovations(
        self, solution: Sim3Solution, believed: BoolArray, tested: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return covariance (E, 7, 7) and residual (E, 7) of each tested edge against all believed ones but itself.

        For an edge in the solution both follow from those after it (R the edge's covariance, P the solution's of the
        same similarity): the innovation's covariance is ``R inv(R - P) R``, the innovation ``R inv(R - P) r``.
        """
        edges = [self.edges[i] for i in tested.tolist()]
        P = solution.relative_covariances([(e.first, e.second) for e in edges])
        r = solution.residuals(edges)
        C = np.empty_like(P)
        for i, (e, inside) in enumerate(zip(edges, believed[tested].tolist(), strict=True)):
            if not inside:
                J = sim3.right_jacobian_inverse(r[i])  # the solution's covariance, seen from the measured similarity
                C[i] = e.covariance + J @ P[i] @ J.T
                continue
            L = np.linalg.cholesky(e.covariance)
            share = np.eye(sim3.DOF) - np.linalg.solve(L, np.linalg.solve(L, P[i]).T)
            values, vectors = np.linalg.eigh((share + share.T) / 2)
            back = vectors / np.maximum(values, LEAST_REDUNDANCY) @ vectors.T
            C[i] = L @ back @ L.T
            r[i] = L @ back @ np.linalg.solve(L, r[i])
        return (C + C.transpose(0, 2, 1)) / 2, r

    def _graduate(self, solution: Sim3Solution, tested: IntArray, covariances: FloatArray) -> BoolArray:
        """Let graduated non-convexity decide about the tested edges, each as uncertain as its innovation."""
        asked = list(self.edges)
        for i, C in zip(tested.tolist(), covariances, strict=True):
            asked[i] = replace(asked[i], covariance=C, doubtful=True)
        held = {self.problem.fixed: self.nodes[self.problem.fixed]}
        return optimise_sim3(solution.S_world_node, asked, held, robust=True).inliers


def _root(parent: list[int], i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


def _join(parent: list[int], a: int, b: int) -> bool:
    """Join two pieces; return whether they were two."""
    a, b = _root(parent, a), _root(parent, b)
    parent[max(a, b)] = min(a, b)
    return a != b
