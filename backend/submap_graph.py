"""One iSAM2 graph per submap: explicit landmarks, Huber-robust projections, and a solver that never takes a map down.

The submap is the record and this graph follows it. An `ISAM2` that has thrown is dead without saying so, therefore
every failure of the solver ends in the same place: a new graph made from the submap's arrays.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np

from dualslam.backend import convert
from dualslam.backend.factor_index import INSERT_SIGMAS, N_NEWEST, FactorIndex, Plan
from dualslam.backend.noise import LEAST_NOISE, OUTLIER_CHI2, PixelNoise, residual_variance
from dualslam.backend.observability import compute_residuals, take_mask
from dualslam.backend.point_refinement import refine_points
from dualslam.backend.reading import (
    READ_ALL,
    READ_WINDOW,
    choose_part,
    landmarks_beside,
    views_of,
)
from dualslam.backend.solver import (
    N_LAST,
    BayesTree,
    IncrementalSolver,
    SolverFailure,
    UpdateStatistics,
    optimise_batch,
)
from dualslam.backend.ties import TieChanges, Ties, insert_projections
from dualslam.core.config.settings import GraphConfig
from dualslam.core.errors import SolverError
from dualslam.core.estimates import GraphEstimate
from dualslam.core.geometry import se3
from dualslam.core.types import FloatArray, IntArray
from dualslam.map.submap import Submap

READ_ALL_EVERY = 10
"""Each so-many-th update reads the whole estimate."""
REBUILD_ITERATIONS = 8
"""Batch iterations at most when a graph is made anew."""
MERGE_ITERATIONS = 2
"""The same when the parts of a submap are solved already, and tracking waits: merging what reverse tracking found (39
keyframes of KITTI 03) two reach the cost of eight to 0.4 %, in half the time."""

logger = logging.getLogger(__name__)

REBUILD_ATTEMPTS = 8
RELINEARISE_EVERY = 3
MISFIT_CHI2 = 1.2
"""Each third update relinearises, and each that follows one whose newest observations fit worse than this."""
FAR_MU = 200.0
"""A point this far from its camera (the median initial depth is 1) is looked at again before the next solution."""


@dataclass(frozen=True, slots=True, eq=False)
class _Changes:
    """A plan as the solver takes it. In `graph`: the ties, then the projections, in this `order`."""

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    remove: list[int]
    ties: TieChanges
    order: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class _Optimum:
    """Batch solution of a submap: poses by keyframe, and all points (those not in it unchanged)."""

    poses: Mapping[int, FloatArray]
    xyz_mu: FloatArray


class ISam2SubmapGraph:
    """The `dualslam.core.interfaces.SubmapGraph` made with GTSAM's iSAM2.

    Reading 20 keyframes by their keys takes 0.25 ms, all of 400 with 10,000 landmarks 3.5 ms. `update` therefore reads
    `READ_WINDOW` keyframes and the landmarks that they see, and everything each `READ_ALL_EVERY`-th time.
    """

    def __init__(self, config: GraphConfig, rebuild_iterations: int = REBUILD_ITERATIONS) -> None:
        self._robust_k, self._rebuild_iterations = config.robust_k, rebuild_iterations
        self._noise = PixelNoise(config.robust_k)
        self._factor_index = FactorIndex(config)
        self._ties = Ties()
        self._solver: IncrementalSolver | None = None
        self._suspects: IntArray = np.zeros(0, np.int64)
        self._n_updates = 0
        self._misfit = False
        self.statistics: tuple[UpdateStatistics, ...] = ()
        """Of the steps that the last update took."""

    # --- the SubmapGraph protocol

    def update(self, submap: Submap) -> GraphEstimate:
        """Take in the rows that were added to the submap or died since the last call, and solve.

        Some calls make the graph anew: the first, one after a change of the submap's gauge (`Submap.transform`), and
        one after its rows were renumbered without the graph's knowledge.

        Raises `SolverError` if the solver failed and the graph could not be made anew either.
        """
        start = time.thread_time()
        if self._solver is None:
            return self._remake(submap, start, rebuilt=False)
        if self._ties.gauge is None or self._ties.gauge.was_moved_in(submap):
            logger.info("submap %d changed its gauge: rebuilding its graph", submap.id)
            return self._remake(submap, start, rebuilt=True)
        if not self._factor_index.knows_rows_of(submap):
            logger.info("submap %d has numbered its observations anew: rebuilding its graph", submap.id)
            return self._remake(submap, start, rebuilt=True)
        try:
            plan = self._factor_index.plan(
                submap, submap.T_submap_kf, submap.landmarks["xyz_mu"], suspects=self._suspects
            )
            changes = self._changes(submap, plan, submap.T_submap_kf, submap.landmarks["xyz_mu"])
            self._solve(self._solver, submap, plan, changes)
            self._n_updates += 1
            everything = self._n_updates % READ_ALL_EVERY == 0
            return self._read(submap, start, plan, everything, rebuilt=False)
        except SolverFailure as failure:
            logger.info("graph of submap %d: %s; rebuilding it", submap.id, failure)
            self._blame(failure, submap)
        return self._remake(submap, start, rebuilt=True)

    def rebuild(self, submap: Submap, near_optimum: bool = False) -> GraphEstimate:
        """Make the graph anew from the submap's arrays (batch optimum seeds a fresh iSAM2); returns everything.

        - `near_optimum`: whether its parts are solved already, so that few iterations are enough.

        Raises `SolverError` if that cannot be done.
        """
        iterations = MERGE_ITERATIONS if near_optimum else self._rebuild_iterations
        return self._remake(submap, time.thread_time(), True, iterations, with_all=True)

    def full_estimate(self, submap: Submap) -> GraphEstimate:
        """Return the estimate of every keyframe and landmark in the graph as of the last update, without solving."""
        if self._solver is None or not self._factor_index.knows_rows_of(submap):
            return self.update(submap)
        try:
            return self._read(submap, time.thread_time(), None, True, rebuilt=False)
        except SolverFailure as failure:
            raise SolverError(f"graph of submap {submap.id}: {failure}; rebuild it") from failure

    def pose_covariance(self, keyframe_id: int) -> FloatArray:
        """Return the (6, 6) marginal covariance of `T_submap_kf` (rotation, translation; in the keyframe's frame).

        Raises `SolverError` if the keyframe is not in the graph, or the solver cannot tell.
        """
        if self._solver is None or keyframe_id not in self._factor_index.keyframes:
            raise SolverError(f"keyframe {keyframe_id} is not in the graph: update it with the keyframe's submap first")
        try:
            return self._solver.covariance(convert.pose_key(keyframe_id))
        except SolverFailure as failure:
            raise SolverError(f"no covariance of keyframe {keyframe_id}: {failure}; rebuild the graph") from failure

    def point_covariances(self, landmark_ids: IntArray) -> FloatArray:
        """Return (L, 3, 3) marginal covariances of landmarks, in the submap's frame; NaN for those not in the graph.

        - `landmark_ids` (L,) int64: one below 0 is none, as in `Submap.landmark_of`: NaN.

        Raises `SolverError` if the solver cannot tell.
        """
        ids = np.asarray(landmark_ids, np.int64)
        covariances = np.full((len(ids), 3, 3), np.nan)
        if self._solver is None:
            return covariances
        for i, j in enumerate(ids.tolist()):
            if j < 0 or not self._solver.has(j):
                continue
            try:
                covariances[i] = self._solver.covariance(j)
            except SolverFailure as failure:
                raise SolverError(f"no covariance of landmark {j}: {failure}; rebuild the graph") from failure
        return covariances

    def rows_out(self, submap: Submap) -> IntArray:
        """Return the rows of dead observations whose factors, if they were any, an update has removed."""
        return self._factor_index.rows_out(submap)

    def keep_rows(self, rows: IntArray) -> None:
        """Follow the submap in that only these rows have stayed in its table."""
        self._factor_index.keep(rows)

    # --- for those who want to look inside

    @property
    def factor_rows(self) -> IntArray:
        """Rows of the submap's observation table that are factors; their landmarks are variables, as the poses are."""
        return np.flatnonzero(self._factor_index.rows["factor"] >= 0)

    def bayes_tree(self) -> BayesTree:
        """Return the incremental solver's current Bayes tree.

        Raises `SolverError` if nothing has been solved yet.
        """
        try:
            if self._solver is not None:
                return self._solver.bayes_tree()
        except SolverFailure as failure:
            raise SolverError(f"no Bayes tree: {failure}; rebuild the graph") from failure
        raise SolverError("there is no Bayes tree before the first update")

    # --- one update

    def _changes(self, submap: Submap, plan: Plan, poses: Mapping[int, FloatArray], xyz_mu: FloatArray) -> _Changes:
        """Translate a plan into factors and values; new variables start from `poses` and `xyz_mu`."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for k in plan.new_keyframes.tolist():
            if not np.isfinite(poses[k]).all():
                raise SolverError(f"submap {submap.id}: the pose of keyframe {k} is not finite; give it a guess")
        remove = self._factor_index.rows["factor"][plan.removing].tolist()

        def pose_now(k: int) -> FloatArray:
            known = self._solver is not None and k in self._factor_index.keyframes
            return self._solver.pose(k) if self._solver is not None and known else poses[k]

        ties = self._ties.changes(graph, submap, plan, pose_now, partial(self._n_rows, submap, plan))
        obs, rows, e = submap.observations, self._factor_index.rows, plan.adding
        K = convert.to_cal3_s2(submap.K)
        order = insert_projections(
            graph, obs["kf"][e], obs["landmark"][e], rows["uv_px"][e], rows["sigma_px"][e], K, self._noise
        )
        new = plan.new_keyframes
        convert.insert_poses(values, new, se3.stack([poses[k] for k in new.tolist()]))
        convert.insert_points(values, plan.new_landmarks, xyz_mu[plan.new_landmarks])
        return _Changes(graph, values, remove + ties.remove, ties, order)

    def _solve(self, solver: IncrementalSolver, submap: Submap, plan: Plan, changes: _Changes) -> None:
        """Let the solver take the changes in, and note the factor indices that it gives."""
        newest = list(submap.keyframes)[-N_LAST:]
        due = self._n_updates % RELINEARISE_EVERY == 0 or self._misfit
        indices = solver.update(changes.graph, changes.values, changes.remove, newest, due)
        projections = len(indices) - len(changes.order)
        self._ties.note(changes.ties, indices[:projections])
        factors = np.empty(len(changes.order), np.int64)
        factors[changes.order] = indices[projections:]
        self._factor_index.commit(plan, factors)
        self.statistics = (solver.statistics,)

    def _n_rows(self, submap: Submap, plan: Plan, keyframe_id: int) -> int:
        kf = submap.observations["kf"]
        inside = np.count_nonzero((self._factor_index.rows["factor"] >= 0) & (kf == keyframe_id))
        change = np.count_nonzero(kf[plan.adding] == keyframe_id) - np.count_nonzero(kf[plan.removing] == keyframe_id)
        return int(inside + change)

    # --- reading

    def _read(
        self,
        submap: Submap,
        start: float,
        plan: Plan | None,
        everything: bool,
        rebuilt: bool,
        optimum: _Optimum | None = None,
    ) -> GraphEstimate:
        """Read the estimate of the window's keyframes (or everything's), and how the window's observations fit.

        The window is the last `READ_WINDOW` keyframes and those just added to. Without a plan, and after a rebuild, it
        is the whole submap. `optimum`: of all that the graph can bear, for use instead of its own.
        """
        assert self._solver is not None
        rows = self._factor_index.rows
        entering = plan.entering if plan is not None else np.zeros(0, np.int64)
        whole = rebuilt or plan is None
        part = choose_part(submap, self._factor_index, entering, READ_ALL if whole else READ_WINDOW, everything)
        kf, lm, inside, row = part.kf, part.lm, part.inside, part.row
        keyframes, landmarks, everything = part.keyframes, part.landmarks, part.is_whole
        if optimum is None:
            T, xyz_graph = self._solver.estimate(keyframes, landmarks, everything)
        else:
            T, xyz_graph = np.array([optimum.poses[k] for k in keyframes.tolist()]), optimum.xyz_mu[landmarks]
        poses = dict(zip(keyframes.tolist(), T, strict=True))
        newest = None if everything else list(submap.keyframes)[-N_NEWEST:]
        beside = landmarks_beside(submap, inside, part.in_graph, newest)
        xyz = (submap.landmarks["xyz_mu"] if optimum is None else optimum.xyz_mu).copy()
        xyz[landmarks] = xyz_graph
        xyz[beside] = self._refined(submap, poses, xyz, beside, inside)
        told = take_mask(landmarks, len(xyz)) | take_mask(beside, len(xyz))
        landmarks = np.flatnonzero(told)

        pose = np.searchsorted(keyframes, kf[row])
        uv_px, sigma_px = rows["uv_px"].take(row, axis=0), rows["sigma_px"][row]
        res = compute_residuals(submap.K, T, pose, xyz.take(lm[row], axis=0), uv_px, sigma_px)
        chi2 = res.chi2
        # The solver threw these points away. Linearised there, they would be the death of it: they go before that.
        self._suspects = np.unique(lm[row[np.isinf(chi2) | (res.depth_mu > FAR_MU)]])
        fresh = chi2[take_mask(entering, len(rows))[row]]
        chi2_newest = float(np.minimum(fresh, INSERT_SIGMAS**2).mean() / 2) if len(fresh) else float("nan")
        self._misfit = chi2_newest > MISFIT_CHI2
        n_views = np.bincount(lm[inside])[lm[row]]
        noise2 = residual_variance(chi2, n_views, LEAST_NOISE**2)
        outliers = row[chi2 > OUTLIER_CHI2 * noise2]
        return GraphEstimate(
            keyframe_ids=keyframes,
            T_submap_kf=T,
            landmark_ids=landmarks,
            xyz_mu=xyz[landmarks],
            outlier_rows=np.union1d(outliers, plan.refused) if plan is not None else outliers,
            chi2_newest=chi2_newest,
            noise2=noise2,
            rebuilt=rebuilt,
            seconds=time.thread_time() - start,
        )

    def _refined(
        self, submap: Submap, poses: Mapping[int, FloatArray], xyz_mu: FloatArray, ids: IntArray, inside: IntArray
    ) -> FloatArray:
        """Return landmarks that are no variables as their views have them; `poses` are those that were read now."""
        views = views_of(submap, ids, inside, poses)
        rows, k = self._factor_index.rows, self._robust_k
        uv, sigma = rows["uv_px"].take(views.row, axis=0), rows["sigma_px"][views.row]
        return refine_points(submap.K, views.T_submap_kf, views.pose, xyz_mu[ids], views.point, uv, sigma, k)

    # --- starting again

    def _reset(self) -> None:
        self._solver = None
        self._ties.clear()
        self._suspects = np.zeros(0, np.int64)
        self._factor_index.clear()

    def _blame(self, failure: SolverFailure, submap: Submap) -> None:
        """Keep the landmark that the solver named out of the next graph, or hold the keyframe that it named."""
        if failure.key is None:
            return
        if not convert.is_pose_key(failure.key):
            self._factor_index.banned.add(failure.key)
        elif convert.keyframe_of(failure.key) in submap.keyframes:
            self._ties.forced.add(convert.keyframe_of(failure.key))

    def _remake(
        self, submap: Submap, start: float, rebuilt: bool, iterations: int | None = None, with_all: bool = False
    ) -> GraphEstimate:
        """Make the graph from the submap's arrays, more cautiously with each attempt that fails.

        `with_all`: the batch solution that it is seeded with takes all observations that can be borne, and is returned.
        """
        if not submap.keyframes:
            raise SolverError(f"submap {submap.id} has no keyframes: there is nothing to solve")
        message = ""
        for attempt in range(REBUILD_ATTEMPTS):
            self._reset()
            if attempt >= REBUILD_ATTEMPTS // 2:
                self._ties.forced.update(submap.keyframes)
            try:
                caution = 1.0 + attempt / 2
                plan, optimum = self._seed(submap, iterations or self._rebuild_iterations, caution, with_all)
                return self._read(submap, start, plan, True, rebuilt, optimum if with_all else None)
            except SolverFailure as failure:
                message = str(failure)
                logger.info("graph of submap %d, attempt %d to make it: %s", submap.id, attempt + 1, failure)
                self._blame(failure, submap)
        self._reset()
        raise SolverError(f"graph of submap {submap.id} could not be made in {REBUILD_ATTEMPTS} attempts: {message}")

    def _seed(self, submap: Submap, iterations: int, caution: float, with_all: bool) -> tuple[Plan, _Optimum]:
        """Batch-optimise what the submap holds, and seed a fresh iSAM2 with the result."""
        poses: Mapping[int, FloatArray] = submap.T_submap_kf
        xyz = submap.landmarks["xyz_mu"]
        plan = self._factor_index.plan(submap, poses, xyz, caution, strict=False, choose=not with_all)
        self._ties.hold_loose_pieces(submap, plan)
        batch = self._changes(submap, plan, poses, xyz)
        optimum = optimise_batch(batch.graph, batch.values, plan.new_keyframes, plan.new_landmarks, iterations)
        poses = dict(zip(plan.new_keyframes.tolist(), optimum.T_submap_kf, strict=True))
        xyz = xyz.copy()
        xyz[plan.new_landmarks] = optimum.xyz_mu
        # Seen from the optimum, some points are no longer certain, or no longer in front: plan again.
        plan = self._factor_index.plan(submap, poses, xyz, caution)
        self._ties.hold_loose_pieces(submap, plan)
        solver = IncrementalSolver()
        self._solve(solver, submap, plan, self._changes(submap, plan, poses, xyz))
        self._solver = solver
        return plan, _Optimum(poses, xyz)
