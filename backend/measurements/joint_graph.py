"""The joint graph: a map's keyframes over Sim(3), tied by the map's own covariances, and readings from outside.

Its nodes stand in the frame of the measurements: the similarity from the map to them is the graph's gauge. A map whose
scale drifts bends. Each source's clock has an offset, each kind of reading its shared unknowns. Graduated
non-convexity (truncated least squares) decides which readings and which doubtful connections count.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from dualslam.backend import convert
from dualslam.backend.measurements.exports import export_graph
from dualslam.backend.measurements.path import CameraPath, Term, attach
from dualslam.backend.measurements.start import MAX_OFFSET_S, find_start
from dualslam.backend.noise import gaussian
from dualslam.backend.solver import GTSAM_ERRORS, SolverFailure
from dualslam.core.chi_square import CHI2_99, CHI2_999
from dualslam.core.errors import InputError, SolverError
from dualslam.core.geometry import sim3, so3
from dualslam.core.metric_problem import MeasurementSource, MetricProblem, MetricSolution, pose_by_node
from dualslam.core.types import FloatArray

ODOMETRY = ("within", "rollover")
LEAST_SIGMAS = np.array([1e-4, 1e-4, 1e-4, 5e-4, 5e-4, 5e-4, 5e-4])
"""As in the atlas' graph: no connection is taken as surer."""
DRIFTS = (1.0, 2.0, 4.0, 8.0)
"""How many times the map's own sigmas are taken: the smallest at which it agrees with the measurements counts."""
TOO_MUCH = 2.33
"""Standard deviations of the joint cost over its expectation: one map in a hundred has more by chance."""
FEW_REJECTED = 0.125
"""Share of readings that are outvoted at which the map need not be asked whether it bends instead."""
MAX_REJECTED = 0.4
"""Share of readings of a kind that may be outvoted: beyond, it is not known who is wrong."""
GAUGE_SIGMAS = np.ones(7)
"""Of a prior on one node of each submap (rad, extents of the map, log-scale): it holds what no measurement fixes."""
GNC_GROWTH, GNC_END = 3.0, 1e3
CLOCK_SIGMAS = 2.5
"""Below, an offset is chance: one in a hundred."""
N_SETTLED = 3
"""Rounds of least squares and hard rejection at the drift that is chosen."""


def solve_metric(
    problem: MetricProblem,
    sources: Sequence[MeasurementSource],
    known_offsets_s: Mapping[str, float] | None = None,
) -> MetricSolution:
    """Put a map into the frame of measurements.

    Parameters
    ----------
    problem : MetricProblem
    sources : sequence of MeasurementSource
    known_offsets_s : mapping of str to float, optional
        Of clocks, by source, that were estimated with another map: they are not estimated again.

    Raises
    ------
    InputError
        In one sentence, where the measurements cannot belong to the map.
    SolverError
    """
    path = CameraPath(problem)
    start = find_start(problem, path, sources, known_offsets_s or {})
    sources = start.sources
    cuts = problem.times_s[np.unique(problem.node, return_index=True)[1]]
    sources = [_integrated(s, np.sort(cuts) - o) for s, o in zip(sources, start.offsets_s, strict=True)]
    terms, outside = attach(path, sources, start.offsets_s)
    if not terms:
        raise InputError(
            f"{', '.join(s.name for s in sources)}: no measurement falls on a time at which the camera has a pose."
        )
    graph = _Joint(problem, sources, terms, start.offsets_s, start.S_metric_world, frozenset(known_offsets_s or {}))
    try:
        solution = graph.solve()
    except GTSAM_ERRORS as error:
        raise SolverError(
            f"the joint graph of {len(problem.S_world_node)} nodes failed: {SolverFailure.of(error)}"
        ) from error
    outside_by_kind = Counter(r.kind for r in outside)
    rejected = Counter(solution.rejected)
    if start.frozen:
        rejected["position"] += start.frozen
    solution = replace(solution, outside=dict(outside_by_kind), rejected=dict(rejected))
    _check_votes(solution, sources)
    return solution


def _integrated(source: MeasurementSource, cuts_s: FloatArray) -> MeasurementSource:
    kinds: dict[type, list[object]] = {}
    for reading in source.readings:
        kinds.setdefault(type(reading), []).append(reading)
    done: list[object] = []
    for cls, readings in kinds.items():
        integrate = getattr(cls, "integrate", None)
        done += readings if integrate is None else integrate(readings, cuts_s)
    return replace(source, readings=done)


def _check_votes(solution: MetricSolution, sources: Sequence[MeasurementSource]) -> None:
    for kind, n in solution.rejected.items():
        total = n + solution.used.get(kind, 0)
        if total >= 3 and n > MAX_REJECTED * total:
            raise InputError(
                f"{', '.join(s.name for s in sources)}: {n} of {total} measurements of {kind} contradict the map and "
                "the others: they are of another recording, or their sigmas are too small."
            )


@dataclass(slots=True, eq=False)
class _Joint:
    """The graph and its weights."""

    problem: MetricProblem
    sources: Sequence[MeasurementSource]
    terms: list[Term]
    offsets_s: Sequence[float]
    S_start: FloatArray
    known_clocks: frozenset[str]
    doubtful: list[int] = field(init=False)
    link_weights: FloatArray = field(init=False)
    values: gtsam.Values = field(init=False)
    drift: float = 1.0

    def __post_init__(self) -> None:
        n = len(self.problem.S_world_node)
        edges = self.problem.edges
        self._held = self._one_of_each_piece()
        self.doubtful = [i for i, kind in enumerate(edges.kind) if kind not in ODOMETRY]
        self.link_weights = np.ones(len(self.doubtful))
        self.values = gtsam.Values()
        for i, S in enumerate(self.S_start @ self.problem.S_world_node):
            self.values.insert(i, convert.to_similarity3(S))
        self._clock = {
            i: n + i
            for i, source in enumerate(self.sources)
            if source.has_clock and source.name not in self.known_clocks
        }
        for key in self._clock.values():
            self.values.insert(key, np.zeros(1))
        self._shared = {}
        for term in self.terms:
            reading = term.reading
            if reading.shared_sigmas and reading.kind not in self._shared:
                self._shared[reading.kind] = n + len(self.sources) + len(self._shared)
                self.values.insert(self._shared[reading.kind], np.zeros(len(reading.shared_sigmas)))

    _held: list[int] = field(init=False)
    _clock: dict[int, int] = field(init=False)
    _shared: dict[str, int] = field(init=False)

    # --- solving

    def solve(self) -> MetricSolution:
        """Choose how far the map may bend and what counts, and solve.

        A stiffer map is preferred: twice the drift must lower the cost by more than chance does. It is not tried where
        the remaining readings agree and few were rejected.
        """
        chosen: tuple[float, float, FloatArray, gtsam.Values] | None = None
        start = gtsam.Values(self.values)
        for i, drift in enumerate(DRIFTS):
            self.drift, self.values = drift, gtsam.Values(start)
            self._weigh(np.ones(len(self.terms) + len(self.doubtful)))
            self._graduate()
            graph = self._optimise()
            dof = sum(len(t.reading.sigmas) for t in self.terms)
            ratio = self._ratios()
            price = float((ratio > 1).sum()) * CHI2_99[3]
            cost = 2.0 * float(graph.error(self.values)) + price + i * TOO_MUCH * float(np.sqrt(2.0 * dof))
            if chosen is None or cost < chosen[0]:
                chosen = (cost, drift, self._weights(), self.values)
            if self._excess(graph) <= TOO_MUCH and (ratio > 1).mean() <= FEW_REJECTED:
                break
        assert chosen is not None
        _, self.drift, weights, self.values = chosen
        self._weigh(weights)
        graph = self._optimise()
        if self._set_clocks_right(graph):
            graph = self._optimise()
        for _ in range(N_SETTLED):
            if not self._reject():
                break
            graph = self._optimise()
        return self._solution(graph, self._excess(graph))

    def _set_clocks_right(self, graph: gtsam.NonlinearFactorGraph) -> bool:
        """Take clocks for right whose offset is less than `CLOCK_SIGMAS` of its sigmas; return whether any was.

        An offset that is estimated in vain costs accuracy along the way: 0.07 s are 0.7 m at 10 m/s.
        """
        marginals = gtsam.Marginals(graph, self.values)
        right = []
        for source, key in self._clock.items():
            sigma = float(np.sqrt(marginals.marginalCovariance(key)[0, 0]))
            if self.offsets_s[source] == 0 and abs(float(self.values.atVector(key)[0])) < CLOCK_SIGMAS * sigma:
                right.append(source)
        for source in right:
            self.values.erase(self._clock.pop(source))
        return bool(right)

    def _graduate(self) -> None:
        """Find the readings and connections that count: graduated non-convexity on truncated least squares."""
        self._optimise(coarsely=True)
        ratio = self._ratios()
        if ratio.max() <= 1.0:
            return
        mu = 1.0 / max(2.0 * float(ratio.max()) - 1.0, 1e-9)
        while mu < GNC_END:
            between = np.sqrt(mu * (mu + 1.0) / np.maximum(ratio, 1e-12)) - mu
            weights = np.where(ratio <= mu / (mu + 1), 1.0, np.where(ratio >= (mu + 1) / mu, 0.0, between))
            self._weigh(weights)
            self._optimise(coarsely=True)
            ratio = self._ratios()
            if ((weights == 0) | (weights == 1)).all() and ((ratio <= 1) == (weights == 1)).all():
                break
            mu *= GNC_GROWTH
        self._weigh((ratio <= 1.0).astype(float))
        self._optimise(coarsely=True)

    def _reject(self) -> bool:
        """Take out what is beyond its quantile, take in what is within; return whether anything changed."""
        before = self._weights()
        after = (self._ratios() <= 1.0).astype(float)
        self._weigh(after)
        return not np.array_equal(before, after)

    def _weights(self) -> FloatArray:
        return np.concatenate(([t.weight for t in self.terms], self.link_weights))

    def _weigh(self, weights: FloatArray) -> None:
        for term, weight in zip(self.terms, weights.tolist(), strict=False):
            term.weight = weight
        self.link_weights = weights[len(self.terms) :]

    def _optimise(self, coarsely: bool = False) -> gtsam.NonlinearFactorGraph:
        graph = self._graph()
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(4 if coarsely else 50)
        params.setLinearSolverType("MULTIFRONTAL_QR")  # Cholesky takes a long chain for indeterminate
        params.setRelativeErrorTol(1e-2 if coarsely else 1e-6)
        self.values = gtsam.LevenbergMarquardtOptimizer(graph, self.values, params).optimize()
        return graph

    def _graph(self) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        weight_of = dict(zip(self.doubtful, self.link_weights.tolist(), strict=True))
        for i, e in enumerate(self.problem.edges):
            weight = weight_of.get(i, 1.0)
            if weight > 1e-4:
                S = convert.to_similarity3(e.S_first_second)
                C = self._edge_covariance(i) / weight
                graph.push_back(gtsam.BetweenFactorSimilarity3(e.first, e.second, S, gaussian(C)))
        extent = float(np.ptp(self.problem.T_world_cam[:, :3, 3], axis=0).max())
        for node in self._held:
            S = self.S_start @ self.problem.S_world_node[node]
            unit = extent / max(float(sim3.scale(self.problem.S_world_node[node])), 1e-12)
            sigmas = GAUGE_SIGMAS * np.repeat([1.0, max(unit, 1e-6), 1.0], [3, 3, 1])
            noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
            graph.push_back(gtsam.PriorFactorSimilarity3(node, convert.to_similarity3(S), noise))
        for source, key in self._clock.items():
            noise = gtsam.noiseModel.Isotropic.Sigma(1, 0.5 * MAX_OFFSET_S)
            graph.push_back(gtsam.PriorFactorVector(key, np.array([-self.offsets_s[source]]), noise))
        for kind, key in self._shared.items():
            sigmas = next(np.asarray(t.reading.shared_sigmas) for t in self.terms if t.reading.kind == kind)
            noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
            graph.push_back(gtsam.PriorFactorVector(key, np.zeros(len(sigmas)), noise))
        for term in self.terms:
            if term.weight > 1e-4:
                noise = gtsam.noiseModel.Diagonal.Sigmas(np.asarray(term.reading.sigmas) / np.sqrt(term.weight))
                graph.push_back(gtsam.CustomFactor(noise, self._keys(term), self._error_of(term)))
        return graph

    def _one_of_each_piece(self) -> list[int]:
        """Return a node of each piece that odometry ties together."""
        piece = np.arange(len(self.problem.S_world_node))
        for e in self.problem.edges:
            if e.kind in ODOMETRY and piece[e.first] != piece[e.second]:
                piece[piece == piece[e.second]] = piece[e.first]
        members = [np.flatnonzero(piece == p) for p in np.unique(piece)]
        return [int(m[len(m) // 2]) for m in members]

    def _edge_covariance(self, i: int) -> FloatArray:
        e = self.problem.edges
        if e.kind[i] in ODOMETRY:
            return np.asarray(self.drift**2 * e.covariance[i])
        return np.asarray(e.covariance[i] + np.diag(LEAST_SIGMAS**2))

    # --- readings as factors

    def _keys(self, term: Term) -> list[int]:
        keys = list(dict.fromkeys(term.nodes))
        if term.source in self._clock:
            keys.append(self._clock[term.source])
        if term.reading.kind in self._shared:
            keys.append(self._shared[term.reading.kind])
        return keys

    def _error_of(self, term: Term):  # type: ignore[no-untyped-def]  # GTSAM's callback
        def error(this: object, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
            r, found = self._evaluate(term, values)
            if jacobians is not None:
                for i, J in enumerate(found):
                    jacobians[i] = np.asfortranarray(J)
            return r

        return error

    def _evaluate(self, term: Term, values: gtsam.Values) -> tuple[FloatArray, list[FloatArray]]:
        """Return residual and Jacobians by `_keys`."""
        clock = self._clock.get(term.source)
        shared_key = self._shared.get(term.reading.kind)
        tau = float(values.atVector(clock)[0]) if clock is not None else 0.0
        shared = values.atVector(shared_key) if shared_key is not None else np.zeros(0)
        T, J_node, J_tau = np.empty((len(term.nodes), 4, 4)), [], []
        for i, node in enumerate(term.nodes):
            M = values.atSimilarity3(node).matrix()
            s = 1.0 / M[3, 3]
            at = term.T_node_cam[i]
            if tau:
                at = at @ _small_motion(tau * term.twist[i])
            T[i] = np.eye(4)
            T[i, :3, :3] = M[:3, :3] @ at[:3, :3]
            T[i, :3, 3] = s * (M[:3, :3] @ at[:3, 3] + M[:3, 3])
            J_node.append(pose_by_node(s, at))
            J_tau.append(term.twist[i] * np.repeat([1.0, s], 3))
        r, J = term.reading.residual(T, shared)
        by_node: dict[int, FloatArray] = {}
        for i, node in enumerate(term.nodes):
            own = J[:, 6 * i : 6 * i + 6] @ J_node[i]
            by_node[node] = by_node[node] + own if node in by_node else own
        found = list(by_node.values())
        if clock is not None:
            found.append((J[:, : 6 * len(T)] @ np.concatenate(J_tau))[:, None])
        if shared_key is not None:
            found.append(J[:, 6 * len(T) :])
        return r, found

    # --- the result

    def _ratios(self) -> FloatArray:
        """Return squared residuals over their quantiles: of readings, then of doubtful connections."""
        found = []
        for term in self.terms:
            r = self._evaluate(term, self.values)[0] / term.reading.sigmas
            found.append(float(r @ r) / CHI2_99[min(len(r), len(CHI2_99) - 1)])
        found += [self._edge_chi2(i) / CHI2_999[7] for i in self.doubtful]
        return np.array(found)

    def _edge_chi2(self, i: int) -> float:
        e = self.problem.edges[i]
        S = [convert.from_similarity3(self.values.atSimilarity3(n)) for n in (e.first, e.second)]
        r = sim3.log(sim3.inverse(e.S_first_second) @ sim3.inverse(S[0]) @ S[1])
        return float(r @ np.linalg.solve(self._edge_covariance(i), r))

    def _excess(self, graph: gtsam.NonlinearFactorGraph) -> float:
        """Return how far the joint cost exceeds its expectation, in its standard deviations."""
        dims = [len(t.reading.sigmas) for t in self.terms if t.weight > 0.5]
        dof = max(sum(dims) - 7, 1)
        return float((2.0 * graph.error(self.values) - dof) / np.sqrt(2.0 * dof))

    def _solution(self, graph: gtsam.NonlinearFactorGraph, excess: float) -> MetricSolution:
        marginals = gtsam.Marginals(graph, self.values)
        nodes = range(len(self.problem.S_world_node))
        C = np.array([marginals.marginalCovariance(n) for n in nodes]).reshape(-1, 7, 7)
        S = np.array([convert.from_similarity3(self.values.atSimilarity3(n)) for n in nodes])
        used, rejected, sums, dims = Counter[str](), Counter[str](), Counter[str](), Counter[str]()
        for term in self.terms:
            kind = term.reading.kind
            if term.weight < 0.5:
                rejected[kind] += 1
                continue
            used[kind] += 1
            r = self._evaluate(term, self.values)[0] / term.reading.sigmas
            sums[kind] += float(r @ r)  # type: ignore[assignment]
            dims[kind] += len(r)
        offsets, sigmas = {}, {}
        for i, key in self._clock.items():
            name = self.sources[i].name
            offsets[name] = self.offsets_s[i] + float(self.values.atVector(key)[0])
            sigmas[name] = float(np.sqrt(marginals.marginalCovariance(key)[0, 0]))
        believed = np.ones(len(self.problem.edges), bool)
        believed[np.array(self.doubtful, int)[self.link_weights < 0.5]] = False
        middle = len(nodes) // 2
        s = float(sim3.scale(S[middle]))
        per_world = s / float(sim3.scale(self.problem.S_world_node[middle]))
        return MetricSolution(
            S_metric_node=S,
            covariance=C,
            believed=believed,
            used=dict(used),
            rejected=dict(rejected),
            outside={},
            normalised={k: float(np.sqrt(sums[k] / dims[k])) for k in used},
            clock_offset_s=offsets,
            clock_sigma_s=sigmas,
            metres_per_unit=per_world,
            scale_sigma=float(np.sqrt(C[middle, 6, 6])),
            rotation_sigma_rad=_largest_sigma(C[middle, :3, :3]),
            translation_sigma_m=s * _largest_sigma(C[middle, 3:6, 3:6]),
            drift=self.drift,
            misfit=excess,
            exports=export_graph(self.problem, S, [t for t in self.terms if t.weight > 0.5]),
        )


def _largest_sigma(C: FloatArray) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(C)[-1]))


def _small_motion(xi: FloatArray) -> FloatArray:
    """Return the pose of a short motion, to second order: `se3.exp` would be half of all the time."""
    W = so3.hat(xi[:3])
    T = np.eye(4)
    T[:3, :3] += W + 0.5 * W @ W
    T[:3, 3] = xi[3:] + 0.5 * W @ xi[3:]
    return T
