"""One iSAM2 graph per submap: explicit landmarks, Huber-robust projections, and a solver that never takes a map down.

The submap is the record and this graph follows it. An `ISAM2` that has thrown is dead without saying so, therefore
every failure of the solver ends in the same place: a new graph made from the submap's arrays.
"""

from __future__ import annotations

import logging
import re
import time
from dataclasses import dataclass

import gtsam
import numpy as np

from backend import convert
from backend.factors import baseline_factor, insert_projections, pose_prior
from backend.gauge import Gauge, choose_gauge
from backend.ledger import OUTSIDE, Ledger, Plan
from backend.membership import compute_residuals, find_components
from backend.noise import PixelNoise
from dualslam.core.config import GraphConfig
from dualslam.core.errors import SolverError
from dualslam.core.interfaces import GraphEstimate
from dualslam.core.submap import Submap
from dualslam.core.types import FloatArray, IntArray

logger = logging.getLogger(__name__)

GTSAM_ERRORS = (RuntimeError, ValueError, IndexError)
"""What GTSAM's C++ exceptions arrive as."""
HOLD_ROTATION_RAD, HOLD_TRANSLATION_MU = 0.01, 0.02
"""Sigmas of the loose prior that holds a keyframe with too few ties where it is."""
REBUILD_ATTEMPTS = 8
MEDIAN_CHI2_2DOF = 1.386


class _SolverFailure(Exception):
    """The solver threw or died; `key` is the variable that it named, if any."""

    def __init__(self, message: str, key: int | None = None) -> None:
        super().__init__(message)
        self.key = key


@dataclass(slots=True)
class _Changes:
    """One update as the solver takes it."""

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    remove: list[int]
    order: IntArray  # of the projections at the end of the graph
    holds: list[int]  # keyframes whose new holds stand, in this order, before the projections
    gauge: Gauge | None  # its factors stand first


class ISam2SubmapGraph:
    """The `dualslam.core.interfaces.SubmapGraph` made with GTSAM's iSAM2.

    Parameters
    ----------
    config : GraphConfig

    Notes
    -----
    How the estimate is read was measured (`docs` of the project carry the table): the keys of the recent window cost
    about 1 ms whatever the size of the map, all of 20,000 landmarks 10 ms. `update` therefore reads
    `GraphConfig.read_window` keyframes and the landmarks that they see, `full_estimate` everything.
    """

    def __init__(self, config: GraphConfig) -> None:
        self._config = config
        self._noise = PixelNoise(config.robust_k)
        self._ledger = Ledger(config)
        self._isam: gtsam.ISAM2 | None = None
        self._gauge: Gauge | None = None
        self._gauge_factors: list[int] = []
        self._holds: dict[int, int] = {}
        self._forced_holds: set[int] = set()

    # --- the SubmapGraph protocol

    def update(self, submap: Submap) -> GraphEstimate:
        """Take in the rows that were added to the submap or died since the last call, and solve.

        The first call, and one that finds the submap moved to another gauge (`Submap.transform`), makes the graph anew.

        Raises
        ------
        SolverError
            If the solver failed and the graph could not be made anew either.
        """
        start = time.perf_counter()
        if self._isam is None:
            return self._remake(submap, start, rebuilt=False)
        if self._gauge is None or self._gauge.was_moved_in(submap):
            logger.info("submap %d changed its gauge: rebuilding its graph", submap.id)
            return self._remake(submap, start, rebuilt=True)
        plan = self._ledger.plan(submap, submap.T_submap_kf, submap.landmarks["xyz_mu"])
        try:
            self._solve(self._isam, self._changes(submap, plan), plan)
            return self._read(submap, start, plan, self._config.read_window, rebuilt=False)
        except _SolverFailure as failure:
            logger.warning("graph of submap %d: %s; rebuilding it", submap.id, failure)
            self._blame(failure, submap)
        return self._remake(submap, start, rebuilt=True)

    def rebuild(self, submap: Submap) -> GraphEstimate:
        """Make the graph anew from the submap's arrays (batch optimum seeds a fresh iSAM2); returns everything.

        Raises
        ------
        SolverError
            If that cannot be done.
        """
        return self._remake(submap, time.perf_counter(), rebuilt=True)

    def full_estimate(self, submap: Submap) -> GraphEstimate:
        """Return the estimate of every keyframe and landmark in the graph as of the last update, without solving."""
        if self._isam is None:
            return self.update(submap)
        nothing = np.zeros(0, np.int64)
        plan = Plan(nothing, nothing, nothing, nothing, nothing, nothing, nothing)
        try:
            return self._read(submap, time.perf_counter(), plan, 0, rebuilt=False)
        except _SolverFailure as failure:
            raise SolverError(f"graph of submap {submap.id}: {failure}; rebuild it") from failure

    def pose_covariance(self, keyframe_id: int) -> FloatArray:
        """Return the (6, 6) marginal covariance of `T_submap_kf` (rotation, translation; in the keyframe's frame).

        Raises
        ------
        SolverError
            If the keyframe is not in the graph, or the solver cannot tell.
        """
        if keyframe_id not in self._ledger.keyframes:
            raise SolverError(f"keyframe {keyframe_id} is not in the graph: update it with the keyframe's submap first")
        return self._marginal(convert.pose_key(keyframe_id), f"keyframe {keyframe_id}")

    def point_covariances(self, landmark_ids: IntArray) -> FloatArray:
        """Return (L, 3, 3) marginal covariances of landmarks, in the submap's frame; NaN for those not in the graph.

        Raises
        ------
        SolverError
            If the solver cannot tell.
        """
        covariances = np.full((len(landmark_ids), 3, 3), np.nan)
        for i, j in enumerate(np.asarray(landmark_ids).tolist()):
            if self._isam is not None and self._isam.valueExists(j):
                covariances[i] = self._marginal(j, f"landmark {j}")
        return covariances

    def _marginal(self, key: int, name: str) -> FloatArray:
        if self._isam is None:
            raise SolverError(f"no covariance of {name}: the graph is empty, update it first")
        try:
            covariance = np.asarray(self._isam.marginalCovariance(key), float)
        except GTSAM_ERRORS as error:
            raise SolverError(f"no covariance of {name}: {_first_line(error)}; rebuild the graph") from error
        return covariance

    # --- one update

    def _changes(
        self, submap: Submap, plan: Plan, poses: dict[int, FloatArray] | None = None, xyz_mu: FloatArray | None = None
    ) -> _Changes:
        """Translate a plan into factors and values."""
        poses = submap.T_submap_kf if poses is None else poses
        xyz_mu = submap.landmarks["xyz_mu"] if xyz_mu is None else xyz_mu
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        remove = self._ledger.rows["factor"][plan.leaving].tolist()
        gauge = choose_gauge(submap, self._gauge, lambda k: self._pose_now(k, poses))
        if gauge is not self._gauge:
            remove += self._gauge_factors
            graph.push_back(pose_prior(gauge.first, gauge.T_submap_first))
            if gauge.second is not None:
                graph.push_back(baseline_factor(gauge.first, gauge.second, gauge.baseline_mu))
        wanted = (set(plan.weak_keyframes.tolist()) | self._forced_holds) - {gauge.first}
        wanted &= submap.keyframes.keys()
        if gauge.second is not None and self._n_rows(submap, plan, gauge.second) >= self._config.min_ties:
            wanted.discard(gauge.second)
        remove += [factor for k, factor in self._holds.items() if k not in wanted]
        holds = sorted(wanted - self._holds.keys())
        for k in holds:
            graph.push_back(pose_prior(k, self._pose_now(k, poses), HOLD_ROTATION_RAD, HOLD_TRANSLATION_MU))
        obs, rows = submap.observations, self._ledger.rows
        e = plan.entering
        order = insert_projections(
            graph,
            obs["kf"][e],
            obs["landmark"][e],
            rows["uv_px"][e],
            rows["sigma_px"][e],
            convert.to_cal3_s2(submap.K),
            self._noise,
        )
        new = plan.new_keyframes
        convert.insert_poses(values, new, np.array([poses[k] for k in new.tolist()]).reshape(-1, 4, 4))
        convert.insert_points(values, plan.new_landmarks, xyz_mu[plan.new_landmarks])
        self._holds = {k: factor for k, factor in self._holds.items() if k in wanted}
        return _Changes(graph, values, remove, order, holds, None if gauge is self._gauge else gauge)

    def _solve(self, isam: gtsam.ISAM2, changes: _Changes, plan: Plan) -> None:
        try:
            result = isam.update(changes.graph, changes.values, changes.remove)
            cliques = result.getCliques()
        except GTSAM_ERRORS as error:
            raise _SolverFailure(_first_line(error), _named_key(error)) from error
        if cliques == 0:
            raise _SolverFailure("the solver is dead (no cliques)")
        indices = np.asarray(result.getNewFactorsIndices(), np.int64)
        head = len(indices) - len(changes.order)
        if changes.gauge is not None:
            self._gauge_factors = indices[: head - len(changes.holds)].tolist()
            self._gauge = changes.gauge
        self._holds.update(zip(changes.holds, indices[head - len(changes.holds) : head].tolist(), strict=True))
        factors = np.empty(len(changes.order), np.int64)
        factors[changes.order] = indices[head:]
        self._ledger.commit(plan, factors)

    def _pose_now(self, keyframe_id: int, poses: dict[int, FloatArray]) -> FloatArray:
        """Return the solver's pose of a keyframe, or the given one if the solver does not have it."""
        if self._isam is not None and keyframe_id in self._ledger.keyframes:
            try:
                return convert.from_pose3(self._isam.calculateEstimatePose3(convert.pose_key(keyframe_id)))
            except GTSAM_ERRORS as error:
                raise _SolverFailure(_first_line(error)) from error
        return poses[keyframe_id]

    def _n_rows(self, submap: Submap, plan: Plan, keyframe_id: int) -> int:
        kf = submap.observations["kf"]
        inside = np.count_nonzero((self._ledger.rows["factor"] >= 0) & (kf == keyframe_id))
        change = np.count_nonzero(kf[plan.entering] == keyframe_id) - np.count_nonzero(kf[plan.leaving] == keyframe_id)
        return int(inside + change)

    # --- reading

    def _read(self, submap: Submap, start: float, plan: Plan, window: int, rebuilt: bool) -> GraphEstimate:
        """Read the estimate of the last `window` keyframes (0: of all), of those just added to, and their landmarks."""
        obs, rows = submap.observations, self._ledger.rows
        kf, lm = obs["kf"], obs["landmark"]
        row = np.flatnonzero(rows["factor"] >= 0)
        if window and len(submap.keyframes) > window:
            recent = list(submap.keyframes)[-window:]
            keyframes = np.union1d(np.array(recent, np.int64), kf[plan.entering])
            active = np.zeros(int(max(kf.max(initial=0), keyframes.max())) + 1, bool)
            active[keyframes] = True
            row = row[active[kf[row]]]
        else:
            keyframes = np.array(sorted(self._ledger.keyframes), np.int64)
        seen = np.zeros(len(submap.landmarks), bool)
        seen[lm[row]] = True
        landmarks = np.flatnonzero(seen)
        T, xyz = self._values(keyframes, landmarks, everything=not window)
        point = np.cumsum(seen) - 1
        pose = np.searchsorted(keyframes, kf[row])
        chi2 = compute_residuals(submap.K, T, pose, xyz[point[lm[row]]], rows["uv_px"][row], rows["sigma_px"][row]).chi2
        newest = chi2[np.isin(row, plan.entering, assume_unique=True)]
        # Where the pixels are noisier than their sigmas say, the gate opens as much: it is for outliers.
        noise = max(1.0, float(np.median(chi2)) / MEDIAN_CHI2_2DOF) if len(chi2) else 1.0
        outliers = row[chi2 > self._config.outlier_chi2 * noise]
        return GraphEstimate(
            keyframes,
            T,
            landmarks,
            xyz,
            np.union1d(outliers, plan.refused),
            float(newest.mean() / 2) if len(newest) else float("nan"),
            rebuilt,
            time.perf_counter() - start,
        )

    def _values(self, keyframes: IntArray, landmarks: IntArray, everything: bool) -> tuple[FloatArray, FloatArray]:
        assert self._isam is not None
        try:
            if everything:
                values = self._isam.calculateEstimate()
            else:
                values = self._isam.calculateEstimate(landmarks.tolist() + convert.pose_keys(keyframes))
            T, xyz = convert.poses_of(values), convert.points_of(values)
        except GTSAM_ERRORS as error:
            raise _SolverFailure(_first_line(error)) from error
        if len(T) != len(keyframes) or len(xyz) != len(landmarks):
            raise _SolverFailure(
                f"the solver holds {len(T)} poses and {len(xyz)} points, {len(keyframes)} and {len(landmarks)} expected"
            )
        if not (np.isfinite(T).all() and np.isfinite(xyz).all()):
            raise _SolverFailure("the estimate is not finite")
        return T, xyz

    # --- starting again

    def _blame(self, failure: _SolverFailure, submap: Submap) -> None:
        """Keep the landmark that the solver named out of the next graph, or hold the keyframe that it named."""
        if failure.key is None:
            return
        if not convert.is_pose_key(failure.key):
            self._ledger.banned.add(failure.key)
        elif convert.keyframe_of(failure.key) in submap.keyframes:
            self._forced_holds.add(convert.keyframe_of(failure.key))

    def _remake(self, submap: Submap, start: float, rebuilt: bool) -> GraphEstimate:
        """Make the graph from the submap's arrays, more cautiously with each attempt that fails."""
        if not submap.keyframes:
            raise SolverError(f"submap {submap.id} has no keyframes: there is nothing to solve")
        message = ""
        for attempt in range(REBUILD_ATTEMPTS):
            self._reset()
            if attempt >= REBUILD_ATTEMPTS // 2:
                self._forced_holds.update(submap.keyframes)
            try:
                plan = self._seed(submap, caution=1.0 + 0.5 * attempt)
                return self._read(submap, start, plan, 0, rebuilt)
            except _SolverFailure as failure:
                message = str(failure)
                logger.warning("graph of submap %d, attempt %d to make it: %s", submap.id, attempt + 1, failure)
                self._blame(failure, submap)
        self._reset()
        raise SolverError(f"graph of submap {submap.id} could not be made in {REBUILD_ATTEMPTS} attempts: {message}")

    def _reset(self) -> None:
        self._isam = None
        self._ledger.clear()
        self._gauge, self._gauge_factors, self._holds = None, [], {}

    def _seed(self, submap: Submap, caution: float) -> Plan:
        """Batch-optimise what the submap holds, and seed a fresh iSAM2 with the result."""
        poses, xyz = submap.T_submap_kf, submap.landmarks["xyz_mu"]
        plan = self._ledger.plan(submap, poses, xyz, caution)
        self._hold_loose_pieces(submap, plan)
        batch = self._changes(submap, plan)
        poses, xyz = self._batch(batch, plan, submap)
        # Seen from the optimum, some points are no longer certain, or no longer in front.
        self._holds = {}
        plan = self._ledger.plan(submap, poses, xyz, caution)
        self._hold_loose_pieces(submap, plan)
        isam = _fresh_isam()
        self._solve(isam, self._changes(submap, plan, poses, xyz), plan)
        self._isam = isam
        return plan

    def _hold_loose_pieces(self, submap: Submap, plan: Plan) -> None:
        """Hold the keyframes of every piece of the graph that is not connected to the gauge."""
        ids, label = find_components(
            submap.observations["kf"][plan.entering], submap.observations["landmark"][plan.entering]
        )
        if len(ids) == 0 or label.max() == 0:
            return
        first = choose_gauge(submap, None, submap.T_submap_kf.__getitem__).first
        home = label[ids == first]
        self._forced_holds.update(ids[label != (home[0] if len(home) else OUTSIDE)].tolist())

    def _batch(self, changes: _Changes, plan: Plan, submap: Submap) -> tuple[dict[int, FloatArray], FloatArray]:
        """Run Levenberg-Marquardt, points eliminated first."""
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(self._config.rebuild_iterations)
        params.setLinearSolverType("SEQUENTIAL_CHOLESKY")
        keyframes, landmarks = plan.new_keyframes, plan.new_landmarks
        params.setOrdering(gtsam.Ordering(landmarks.tolist() + convert.pose_keys(keyframes)))
        try:
            values = gtsam.LevenbergMarquardtOptimizer(changes.graph, changes.values, params).optimize()
        except GTSAM_ERRORS as error:
            raise _SolverFailure(_first_line(error), _named_key(error)) from error
        poses = dict(zip(keyframes.tolist(), convert.poses_of(values), strict=True))
        xyz = submap.landmarks["xyz_mu"].copy()
        xyz[landmarks] = convert.points_of(values)
        if not (np.isfinite(xyz[landmarks]).all() and all(np.isfinite(T).all() for T in poses.values())):
            raise _SolverFailure("the batch estimate is not finite")
        return poses, xyz


def _fresh_isam() -> gtsam.ISAM2:
    """Make an empty iSAM2 with the thresholds that were measured for maps of median depth 1."""
    thresholds = gtsam.ISAM2ThresholdMap()
    thresholds.insert(("x", np.array([0.002] * 3 + [0.01] * 3)))
    thresholds.insert((chr(0), np.full(3, 0.1)))  # plain-int keys have the character 0
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(thresholds)
    params.relinearizeSkip = 1
    params.enablePartialRelinearizationCheck = True
    return gtsam.ISAM2(params)


def _first_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join(lines[:2])[:200] if lines else type(error).__name__


def _named_key(error: Exception) -> int | None:
    """Return the variable that an indeterminate-system text names."""
    found = re.search(r"variable\s+(\d+)", str(error))
    return int(found.group(1)) if found else None
