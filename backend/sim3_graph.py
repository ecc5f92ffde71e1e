"""Similarities between keyframes and submaps: a pose graph over Sim(3), solved in batch.

Here the drift of a monocular map's scale is undone: recovery links and loop closures are edges, and what the optimum
says about keyframes is handed back to their submaps. Links may be wrong, so an edge can be marked as doubtful;
graduated non-convexity then decides which of them to believe.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from dualslam.backend import convert
from dualslam.backend.noise import GAUGE_SIGMA, gaussian
from dualslam.backend.observability import find_components
from dualslam.backend.solver import GTSAM_ERRORS, SolverFailure
from dualslam.core.errors import SolverError
from dualslam.core.geometry import se3, sim3
from dualslam.core.types import BoolArray, FloatArray, IntArray

GNC_INLIER_PROBABILITY = 0.99
"""A doubtful edge is an outlier beyond this quantile of the chi-square with 7 degrees of freedom."""

GNC_STEP, GNC_TOLERANCE = 2.0, 1e-3
"""By how much each round is less convex than the one before, and how far each is solved. With 1.4 and 1e-8 a choice
took nearly twice as long (1,070 nodes, 150 doubtful edges, 50 of them false), and judged all of them alike."""


@dataclass(frozen=True, slots=True, eq=False)
class Sim3Edge:
    """A measured similarity between two nodes.

    - `S_first_second` (4, 4): ``[[s R, t], [0, 1]]``, takes coordinates in the second node to the first.
    - `covariance` (7, 7): of the right perturbation ``S_first_second @ exp(xi)``, order rotation, translation,
      log-scale: in the second node's frame and unit.
    - `doubtful`: where true, robust optimisation may refuse the edge.
    """

    first: int
    second: int
    S_first_second: FloatArray
    covariance: FloatArray
    doubtful: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Sim3Solution:
    """The optimum of a graph over Sim(3).

    - `S_world_node` dict of int to (4, 4).
    - `inliers` (E,) bool: false for the doubtful edges that were refused.
    - `cost_before`, `cost_after`: half the sum of squared whitened residuals of the edges that were kept.
    """

    S_world_node: dict[int, FloatArray]
    inliers: BoolArray
    cost_before: float
    cost_after: float
    _graph: gtsam.NonlinearFactorGraph = field(repr=False)
    _values: gtsam.Values = field(repr=False)

    def relative_covariances(self, pairs: Sequence[tuple[int, int]]) -> FloatArray:
        """Return (P, 7, 7) covariances of ``inv(S_world_first) @ S_world_second``: right perturbation, second's frame.

        Raises `SolverError` if the solver cannot tell.
        """
        found = np.empty((len(pairs), sim3.DOF, sim3.DOF))
        try:
            marginals = gtsam.Marginals(self._graph, self._values)
            for i, (first, second) in enumerate(pairs):
                joint = marginals.jointMarginalCovariance([int(first), int(second)])
                C = np.block([[np.asarray(joint.at(a, b)) for b in (first, second)] for a in (first, second)])
                S_second_first = sim3.inverse(self.S_world_node[second]) @ self.S_world_node[first]
                J = np.concatenate((-sim3.adjoint(S_second_first), np.eye(sim3.DOF)), axis=1)
                found[i] = J @ C @ J.T
        except GTSAM_ERRORS as error:
            raise SolverError(f"no covariances between {len(pairs)} pairs of Sim(3) nodes: {error}") from error
        return (found + found.transpose(0, 2, 1)) / 2

    def residuals(self, edges: Sequence[Sim3Edge]) -> FloatArray:
        """Return (E, 7): how far the nodes stand off each edge, in the edge's own tangent space."""
        S = [sim3.inverse(self.S_world_node[e.first]) @ self.S_world_node[e.second] for e in edges]
        measured = se3.stack([e.S_first_second for e in edges])
        return sim3.log(sim3.inverse(measured) @ se3.stack(S))


def optimise_sim3(
    nodes: Mapping[int, FloatArray],
    edges: Sequence[Sim3Edge],
    fixed: Mapping[int, FloatArray] | None = None,
    robust: bool = False,
    max_iterations: int = 50,
    settled_cost: float = 0.0,
) -> Sim3Solution:
    """Find the similarities that agree best with the edges.

    A piece of the graph without a fixed node keeps its lowest one where it is: there is always a gauge.

    Parameters
    ----------
    nodes : mapping of int to (4, 4)
        Initial ``S_world_node``.
    edges : sequence of Sim3Edge
    fixed : mapping of int to (4, 4), optional
        Nodes that are held, and where.
    robust : bool
        Let graduated non-convexity choose among the doubtful edges; else all edges count.
    max_iterations : int
        Of Levenberg-Marquardt.
    settled_cost : float
        With no more than this to gain the nodes stay as they are, to the bit.

    Raises
    ------
    SolverError
        If an edge or `fixed` names a node that is not there, a similarity is not one, or the solver fails.
    """
    held = dict(fixed or {})
    if not nodes:
        raise SolverError("a graph over Sim(3) needs at least one node")
    for name in [n for e in edges for n in (e.first, e.second)] + list(held):
        if name not in nodes:
            raise SolverError(f"an edge or a fixed node names Sim(3) node {name}, which is not in the graph")
    for lonely in _loose_pieces(np.array(sorted(nodes), np.int64), edges, held):
        held[lonely] = nodes[lonely]
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    try:
        for e in edges:
            S = convert.to_similarity3(e.S_first_second)
            graph.push_back(gtsam.BetweenFactorSimilarity3(int(e.first), int(e.second), S, gaussian(e.covariance)))
        gauge = gaussian(GAUGE_SIGMA**2 * np.eye(sim3.DOF))
        for name, S_world_node in held.items():
            graph.push_back(gtsam.PriorFactorSimilarity3(int(name), convert.to_similarity3(S_world_node), gauge))
        for name, S_world_node in nodes.items():
            values.insert(int(name), convert.to_similarity3(S_world_node))
        inliers = np.ones(len(edges), bool)
        doubtful = np.array([e.doubtful for e in edges], bool)
        if robust and doubtful.any():
            inliers = _choose_edges(graph, values, doubtful, max_iterations)
            graph = _without(graph, np.flatnonzero(~inliers))
        before = float(graph.error(values))
        if before <= settled_cost:
            return Sim3Solution(dict(nodes), inliers, before, before, graph, values)
        result = gtsam.LevenbergMarquardtOptimizer(graph, values, _lm_params(max_iterations)).optimize()
        after = float(graph.error(result))
        found = {int(n): convert.from_similarity3(result.atSimilarity3(int(n))) for n in nodes}
    except GTSAM_ERRORS as error:
        raise SolverError(f"the graph of {len(nodes)} Sim(3) nodes failed: {SolverFailure.of(error)}") from error
    if not all(np.isfinite(S).all() for S in found.values()):
        raise SolverError(f"the graph of {len(nodes)} Sim(3) nodes diverged: its estimate is not finite")
    return Sim3Solution(found, inliers, before, after, graph, result)


def _lm_params(max_iterations: int) -> gtsam.LevenbergMarquardtParams:
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(max_iterations)
    params.setRelativeErrorTol(1e-8)
    params.setAbsoluteErrorTol(1e-10)
    return params


def _choose_edges(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, doubtful: BoolArray, max_iterations: int
) -> BoolArray:
    """Return which edges graduated non-convexity believes; the other factors of the graph are taken as true."""
    inner = _lm_params(max_iterations)
    inner.setRelativeErrorTol(GNC_TOLERANCE)  # the next weights come anyway
    params = gtsam.GncLMParams(inner)
    params.setLambdaStep(GNC_STEP)
    sure = np.ones(graph.size(), bool)
    sure[np.flatnonzero(doubtful)] = False
    params.setKnownInliers(np.flatnonzero(sure).tolist())
    optimizer = gtsam.GncLMOptimizer(graph, values, params)
    optimizer.setInlierCostThresholdsAtProbability(GNC_INLIER_PROBABILITY)
    optimizer.optimize()
    weights = np.asarray(optimizer.getWeights(), float).ravel()[: len(doubtful)]
    return ~doubtful | (weights > 0.5)


def _without(graph: gtsam.NonlinearFactorGraph, indices: IntArray) -> gtsam.NonlinearFactorGraph:
    dropped = set(indices.tolist())
    kept = gtsam.NonlinearFactorGraph()
    for i in range(graph.size()):
        if i not in dropped:
            kept.push_back(graph.at(i))
    return kept


def _loose_pieces(nodes: IntArray, edges: Sequence[Sim3Edge], fixed: Mapping[int, FloatArray]) -> list[int]:
    """Return the lowest node of each connected piece without a fixed one (doubtful edges do not connect)."""
    sure = [(e.first, e.second) for e in edges if not e.doubtful]
    n = len(edges)
    node = np.concatenate([nodes, np.array(sure, np.int64).ravel()])
    through = np.concatenate([n + np.arange(len(nodes)), np.repeat(np.arange(len(sure)), 2)])
    ids, label = find_components(node, through)
    held = set(label[np.isin(ids, list(fixed))].tolist())
    return [int(ids[label == piece].min()) for piece in np.unique(label).tolist() if piece not in held]
