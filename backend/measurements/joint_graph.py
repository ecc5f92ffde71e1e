"""The joint graph: a map's keyframes over Sim(3), tied by the map's own covariances, and readings from outside.

Its nodes stand in the frame of the measurements: the similarity from the map to them is the graph's gauge. A map whose
scale drifts bends. Each source's clock has an offset, each kind of reading its shared unknowns. Graduated
non-convexity (truncated least squares) decides which readings and which doubtful connections count.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from typing import Self

import gtsam
import numpy as np
from scipy.linalg import solve_triangular

from dualslam.backend import convert
from dualslam.backend.atlas_solver import LEAST_SIGMAS
from dualslam.backend.measurements.exports import export_graph
from dualslam.backend.measurements.path import CameraPath, Term, attach
from dualslam.backend.measurements.start import MAX_OFFSET_S, POSITION, QUANTILE_99, MetricStart, find_start, up_of
from dualslam.backend.noise import gaussian
from dualslam.backend.solver import GTSAM_ERRORS
from dualslam.core.chi_square import CHI2_99, CHI2_999, MEDIAN_CHI2
from dualslam.core.errors import InputError
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.metric_problem import MeasurementSource, MetricProblem, MetricSolution, pose_by_node
from dualslam.core.noise_model import ROBUST_N, TINY
from dualslam.core.types import FloatArray

ODOMETRY = ("within", "rollover")
DRIFTS = (1.0, 2.0, 4.0, 8.0)
"""How many times the map's own sigmas are taken: the smallest at which it agrees with the measurements counts."""
STIFFER = (0.5, 0.25)
"""A map's sigmas hold for any camera: of an exact one its errors are a thirtieth to a third. Readings say of which."""
FEW_REJECTED = 0.125
"""Share of readings that are outvoted at which the map need not be asked whether it bends instead."""
GAUGE_SIGMAS = np.ones(7)
"""Of a prior on one node of each submap (rad, extents of the map, log-scale): it holds what no measurement fixes."""
GNC_GROWTH, GNC_END = 3.0, 1e3
N_SETTLED = 3
"""Rounds of least squares and hard rejection."""
UPRIGHT_SIGMA = 0.5
"""Length of the difference between the camera's up and the sky, of a camera that a person or a vehicle carries."""
MAX_RUN = 2
"""Neighbouring positions that may be outvoted where the map bends: three are chance once in a million."""


def _integrated(source: MeasurementSource, cuts_s: FloatArray) -> MeasurementSource:
    done: list[object] = []
    for cls in dict.fromkeys(map(type, source.readings)):
        readings = [r for r in source.readings if type(r) is cls]
        integrate = getattr(cls, "integrate", None)
        done += readings if integrate is None else integrate(readings, cuts_s)
    return replace(source, readings=done)


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """A solution at one drift; plain: what counts agrees with the map, and few readings do not count."""

    cost: float
    drift: float
    weights: FloatArray
    values: gtsam.Values
    is_plain: bool


class JointGraph:
    """The graph and its weights."""

    def __init__(self, problem: MetricProblem, start: MetricStart, known: Mapping[str, float]) -> None:
        self.problem, self.offsets_s, self.n_repeated = problem, start.offsets_s, start.n_repeated
        cuts = np.sort(problem.times_s[np.unique(problem.node, return_index=True)[1]])
        self.sources = [_integrated(s, cuts - o) for s, o in zip(start.sources, start.offsets_s, strict=True)]
        self.terms, self.outside = attach(CameraPath(problem), self.sources, self.offsets_s)
        if not self.terms:
            names = ", ".join(s.name for s in self.sources)
            raise InputError(f"{names}: no measurement falls on a time at which the camera has a pose.")
        self.S_start, self._held = start.S_metric_world, self._one_of_each_piece()
        self.doubtful = [i for i, kind in enumerate(problem.edges.kind) if kind not in ODOMETRY]
        self.link_weights = np.ones(len(self.doubtful))
        self.drift, self.cost, self.is_plain = 1.0, np.inf, False
        self.jumps_s: dict[int, float] = {}
        self.values, n = gtsam.Values(), len(problem.S_world_node)
        for i, S in enumerate(self.S_start @ problem.S_world_node):
            self.values.insert(i, convert.to_similarity3(S))
        self._clock = {i: n + i for i, s in enumerate(self.sources) if s.has_clock and s.name not in known}
        self._right_clocks: dict[int, float] = {}
        for key in self._clock.values():
            self.values.insert(key, np.zeros(1))
        self._shared: dict[str, int] = {}
        for reading in (term.reading for term in self.terms):
            if reading.shared_sigmas and reading.kind not in self._shared:
                self._shared[reading.kind] = n + len(self.sources) + len(self._shared)
                self.values.insert(self._shared[reading.kind], np.zeros(len(reading.shared_sigmas)))

    @classmethod
    def solved(
        cls,
        problem: MetricProblem,
        sources: Sequence[MeasurementSource],
        known: Mapping[str, float],
        drifts: Sequence[float],
    ) -> Self:
        """Choose how far the map may bend and what counts, and solve.

        A stiffer map is preferred: twice the drift must lower the cost by more than chance does. It is not tried where
        the remaining readings agree and few were rejected.
        """
        self = cls(problem, find_start(problem, CameraPath(problem), sources, known), known)
        start = gtsam.Values(self.values)
        best = self._tried(drifts[0], start)
        self._take(best)
        self.jumps_s = self._clock_jumps_s()
        self.is_plain = best.is_plain and self._tilt() <= CHI2_99[3] and len(self.longest_run()) <= MAX_RUN
        dof = sum(len(r.sigmas) for r in (*(t.reading for t in self.terms), *self.outside))
        price = QUANTILE_99 * float(np.sqrt(2.0 * dof))
        for i, drift in enumerate(drifts[1:], 1):
            if best.is_plain or best.cost < dof + i * price:  # no cost falls below its expectation but by chance
                break
            tried = self._tried(drift, start, i * price)
            if tried.cost < best.cost:
                best = tried
            if tried.is_plain:
                break
        self._take(best)
        self.cost = best.cost + self._tilt()
        return self

    def _tried(self, drift: float, start: gtsam.Values, price: float = 0.0) -> _Trial:
        """Solve at a drift, from two beginnings where the first rejects anything."""
        self.drift, trials = drift, []
        price += sum(len(r.sigmas) for r in self.outside)
        for begin in (self._graduate, self._trust_start):
            self.values = gtsam.Values(start)
            begin()
            graph = self._optimise()
            wrong = self._ratios() > 1
            cost = 2.0 * float(graph.error(self.values)) + float(wrong.sum()) * CHI2_99[3] + price
            is_plain = bool(self._excess(graph) <= QUANTILE_99 and wrong.mean() <= FEW_REJECTED)
            trials.append(_Trial(cost, drift, (~wrong).astype(float), self.values, is_plain))
            if (trials[0].weights > 0.5).all():
                break
        return min(trials, key=lambda trial: trial.cost)

    def rebate(self) -> float:
        """Return what neighbouring positions that are outvoted cost too much: a burst of them is one event."""
        wrong = [t.weight < 0.5 and t.reading.kind == POSITION for t in self.terms]
        return float((CHI2_99[3] - 3) * sum(here and before for before, here in pairwise(wrong)))

    def _take(self, trial: _Trial) -> None:
        self.drift, self.values = trial.drift, trial.values
        self._weigh(trial.weights)

    def solution(self) -> MetricSolution:
        """Refine what was found, and return it."""
        graph = self._optimise()
        if self.drift == 1.0:
            graph = self._stiffened(graph)
        if self._set_clocks_right(graph):
            graph = self._optimise()
        for _ in range(N_SETTLED):
            if not self._reject():
                break
            graph = self._optimise()
        return self._solution(graph, self._excess(graph))

    def _stiffened(self, graph: gtsam.NonlinearFactorGraph) -> gtsam.NonlinearFactorGraph:
        """Take the map's sigmas smaller as long as the readings are more likely so."""
        least = self._improbability(graph)
        for drift in STIFFER:
            before = self.drift, self.values
            self.drift = drift
            stiffer = self._optimise()
            improbability = self._improbability(stiffer)
            if improbability >= least:
                self.drift, self.values = before
                break
            least, graph = improbability, stiffer
        return graph

    def _improbability(self, graph: gtsam.NonlinearFactorGraph) -> float:
        """Return minus twice the logarithm of the probability of the readings at this drift, up to a constant.

        It is Laplace's approximation. Readings that say nothing of the drift have the same at any. Infinite if so
        little holds the gauge that the normal equations have no digits left.
        """
        try:
            information = 2.0 * float(graph.linearize(self.values).eliminateMultifrontal().logDeterminant())
        except GTSAM_ERRORS:
            return float(np.inf)
        n_scaled = sim3.DOF * sum(kind in ODOMETRY for kind in self.problem.edges.kind)
        return float(2.0 * graph.error(self.values) + information + 2.0 * n_scaled * np.log(self.drift))

    def longest_run(self) -> list[float]:
        """Return the times of the most positions in a row that are outvoted."""
        positions = [t for t in self.terms if t.reading.kind == POSITION]
        runs = [[t.reading.t_s for t in run] for counts, run in groupby(positions, _counts) if not counts]
        return max(runs, key=len, default=[])

    def _clock_jumps_s(self) -> dict[int, float]:
        """Return, by source, where its clock's offset changes most: by medians of positions before and after."""
        found = {}
        for source in self._clock:
            terms = [t for t in self.terms if t.source == source and t.reading.kind == POSITION]
            late = []
            for term in terms:
                r, J = self._evaluate(term, self.values)
                late.append(float(J[-1][:, 0] @ r) / max(float(J[-1][:, 0] @ J[-1][:, 0]), TINY))
            steps = [
                abs(np.median(late[i - ROBUST_N : i]) - np.median(late[i : i + ROBUST_N]))
                for i in range(ROBUST_N, len(late) - ROBUST_N + 1)
            ]
            if steps:
                found[source] = float(terms[ROBUST_N + int(np.argmax(steps))].reading.t_s)
        return found

    def _tilt(self) -> float:
        """Return the squared distance of the camera's up from the sky, in sigmas; 0 where the sky is not known."""
        up = up_of(self.problem)
        if up is None or all(source.origin is None for source in self.sources):
            return 0.0
        middle = len(self.problem.S_world_node) // 2
        S_metric_node = convert.from_similarity3(self.values.atSimilarity3(middle))
        S = S_metric_node @ sim3.inverse(self.problem.S_world_node[middle])
        return float((((sim3.rotation(S) @ up - [0.0, 0.0, 1.0]) / UPRIGHT_SIGMA) ** 2).sum())

    def _set_clocks_right(self, graph: gtsam.NonlinearFactorGraph) -> bool:
        """Take clocks for right whose offset may be chance, as one in a hundred is larger; return whether any was.

        An offset that is estimated in vain costs accuracy along the way: 0.07 s are 0.7 m at 10 m/s.
        """
        covariance = self._covariances(graph)
        n = len(self._clock)
        for source, key in list(self._clock.items()):
            sigma = float(np.sqrt(covariance(key)[0, 0]))
            if abs(self.offsets_s[source] + float(self.values.atVector(key)[0])) < np.sqrt(CHI2_99[1]) * sigma:
                self.values.erase(self._clock.pop(source))
                self._right_clocks[source] = -self.offsets_s[source]
        return len(self._clock) < n

    def _graduate(self) -> None:
        """Find the readings and connections that count: graduated non-convexity on truncated least squares."""
        self._optimise(coarsely=True)
        ratio = self._ratios()
        if ratio.max() <= 1.0:
            return
        mu = 1.0 / max(2.0 * float(ratio.max()) - 1.0, TINY)
        while mu < GNC_END:
            between = np.sqrt(mu * (mu + 1.0) / np.maximum(ratio, TINY)) - mu
            weights = np.where(ratio <= mu / (mu + 1), 1.0, np.where(ratio >= (mu + 1) / mu, 0.0, between))
            self._weigh(weights)
            self._optimise(coarsely=True)
            ratio = self._ratios()
            if ((weights == 0) | (weights == 1)).all() and ((ratio <= 1) == (weights == 1)).all():
                break
            mu *= GNC_GROWTH
        self._weigh((ratio <= 1.0).astype(float))
        self._optimise(coarsely=True)

    def _trust_start(self) -> None:
        """Begin with the readings that agree with the robust rigid alignment, then reject and take in by turns."""
        ratio = self._ratios()
        kinds = np.array([t.reading.kind for t in self.terms] + [""] * len(self.doubtful))
        weights = np.ones(len(ratio))
        for kind in {t.reading.kind for t in self.terms}:
            of_kind = ratio[kinds == kind]
            weights[kinds == kind] = of_kind <= np.median(of_kind) * CHI2_999[3] / MEDIAN_CHI2[3]
        self._weigh(weights)
        for _ in range(N_SETTLED):
            self._optimise(coarsely=True)
            if not self._reject():
                break

    def _reject(self) -> bool:
        """Take out what is beyond its quantile, take in what is within; return whether anything changed."""
        before = self._weights()
        self._weigh((self._ratios() <= 1.0).astype(float))
        return not np.array_equal(before, self._weights())

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
        extent = float(np.ptp(se3.translation(self.problem.T_world_cam), axis=0).max())
        for node in self._held:
            S = self.S_start @ self.problem.S_world_node[node]
            unit = extent / max(float(sim3.scale(self.problem.S_world_node[node])), TINY)
            sigmas = GAUGE_SIGMAS * np.repeat([1.0, max(unit, 1e-6), 1.0], [3, 3, 1])
            noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
            graph.push_back(gtsam.PriorFactorSimilarity3(node, convert.to_similarity3(S), noise))
        for source, key in self._clock.items():
            noise = gtsam.noiseModel.Isotropic.Sigma(1, MAX_OFFSET_S / 2)
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
        tau = self._right_clocks.get(term.source, 0.0) if clock is None else float(values.atVector(clock)[0])
        shared = values.atVector(shared_key) if shared_key is not None else np.zeros(0)
        T, J_node, J_tau = np.empty((len(term.nodes), 4, 4)), [], []
        for i, node in enumerate(term.nodes):
            M = values.atSimilarity3(node).matrix()
            s = 1.0 / M[3, 3]
            at = term.T_node_cam[i]
            if tau:
                at = at @ _small_motion(tau * term.twist[i])
            R, t = se3.rotation(M), se3.translation(M)
            T[i] = se3.from_parts(R @ se3.rotation(at), s * (R @ se3.translation(at) + t))
            J_node.append(pose_by_node(s, at))
            J_tau.append(term.twist[i] * np.repeat([1.0, s], 3))
        r, J = term.reading.residual(T, shared)
        by_node: dict[int, FloatArray] = {}
        for i, node in enumerate(term.nodes):
            by_node[node] = by_node.get(node, 0.0) + J[:, se3.DOF * i : se3.DOF * i + se3.DOF] @ J_node[i]
        found = list(by_node.values())
        if clock is not None:
            found.append((J[:, : se3.DOF * len(T)] @ np.concatenate(J_tau))[:, None])
        if shared_key is not None:
            found.append(J[:, se3.DOF * len(T) :])
        return r, found

    # --- the result

    def _ratios(self) -> FloatArray:
        """Return squared residuals over their quantiles: of readings, then of doubtful connections."""
        whitened = [self._evaluate(t, self.values)[0] / t.reading.sigmas for t in self.terms]
        found = [float(r @ r) / CHI2_99[min(len(r), len(CHI2_99) - 1)] for r in whitened]
        return np.array(found + [self._edge_chi2(i) / CHI2_999[sim3.DOF] for i in self.doubtful])

    def _edge_chi2(self, i: int) -> float:
        e = self.problem.edges[i]
        S = [convert.from_similarity3(self.values.atSimilarity3(n)) for n in (e.first, e.second)]
        r = sim3.log(sim3.inverse(e.S_first_second) @ sim3.inverse(S[0]) @ S[1])
        return float(r @ np.linalg.solve(self._edge_covariance(i), r))

    def _excess(self, graph: gtsam.NonlinearFactorGraph) -> float:
        """Return how far the joint cost exceeds its expectation, in its standard deviations."""
        dof = max(sum(len(t.reading.sigmas) for t in self.terms if _counts(t)) - sim3.DOF, 1)
        return float((2.0 * graph.error(self.values) - dof) / np.sqrt(2.0 * dof))

    def _covariances(self, graph: gtsam.NonlinearFactorGraph) -> Callable[[int], FloatArray]:
        """Return a function that gives the covariance of a key.

        GTSAM squares the problem. Where no reading holds the gauge that takes half of the digits too many.
        """
        try:
            marginals = gtsam.Marginals(graph, self.values)
            return lambda key: np.asarray(marginals.marginalCovariance(key))
        except GTSAM_ERRORS:
            A, _ = graph.linearize(self.values).jacobian()  # its columns are in the order of the keys
        root = solve_triangular(np.linalg.qr(A, mode="r"), np.eye(A.shape[1]))
        keys, n = sorted(self.values.keys()), len(self.problem.S_world_node)
        ends = np.cumsum([sim3.DOF if key < n else len(self.values.atVector(key)) for key in keys])
        rows = dict(zip(keys, np.split(root, ends[:-1]), strict=True))
        return lambda key: np.asarray(rows[key] @ rows[key].T)

    def _solution(self, graph: gtsam.NonlinearFactorGraph, excess: float) -> MetricSolution:
        covariance = self._covariances(graph)
        nodes = range(len(self.problem.S_world_node))
        C = np.array([covariance(n) for n in nodes]).reshape(-1, sim3.DOF, sim3.DOF)
        S = np.array([convert.from_similarity3(self.values.atSimilarity3(n)) for n in nodes])
        count = [t for t in self.terms if _counts(t)]
        whitened: dict[str, list[FloatArray]] = {}
        for term in count:
            r = self._evaluate(term, self.values)[0] / term.reading.sigmas
            whitened.setdefault(term.reading.kind, []).append(r)
        clocks = {self.sources[i].name: (i, key) for i, key in self._clock.items()}
        believed = np.ones(len(self.problem.edges), bool)
        believed[self.doubtful] = self.link_weights > 0.5
        middle = len(nodes) // 2
        s = float(sim3.scale(S[middle]))
        per_world = s / float(sim3.scale(self.problem.S_world_node[middle]))
        return MetricSolution(
            S_metric_node=S,
            covariance=C,
            believed=believed,
            used={kind: len(r) for kind, r in whitened.items()},
            rejected=dict(Counter(t.reading.kind for t in self.terms if not _counts(t))),
            outside=dict(Counter(r.kind for r in self.outside)),
            repeated=self.n_repeated,
            normalised_rms={kind: float(np.sqrt((np.concatenate(r) ** 2).mean())) for kind, r in whitened.items()},
            clock_offset_s={n: self.offsets_s[i] + float(self.values.atVector(k)[0]) for n, (i, k) in clocks.items()},
            clock_sigma_s={n: float(np.sqrt(covariance(k)[0, 0])) for n, (_, k) in clocks.items()},
            metres_per_unit=per_world,
            scale_sigma=float(np.sqrt(C[middle, -1, -1])),
            rotation_sigma_rad=_largest_sigma(C[middle, :3, :3]),
            translation_sigma_m=s * _largest_sigma(C[middle, 3 : se3.DOF, 3 : se3.DOF]),
            drift=self.drift,
            misfit_sigmas=excess,
            exports=export_graph(self.problem, S, count),
        )


def _counts(term: Term) -> bool:
    return term.weight > 0.5


def _largest_sigma(C: FloatArray) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(C)[-1]))


def _small_motion(xi: FloatArray) -> FloatArray:
    """Return the pose of a short motion, to second order: `se3.exp` would be half of all the time."""
    W = so3.hat(xi[:3])
    return se3.from_parts(np.eye(len(W)) + W + W / 2 @ W, xi[3:] + W / 2 @ xi[3:])
