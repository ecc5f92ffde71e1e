"""iSAM2 and batch Levenberg-Marquardt behind calls that raise one kind of failure and never hand on a dead solver.

Settings, measured on corridors of 100-300 keyframes with 250 observations each (2 cores, CPU time):

=============================================================  ===============  ==================
what                                                           ms per update    cost over optimum
=============================================================  ===============  ==================
landmark threshold 0.1, pose 0.002 / 0.01, default ordering    15, grows > 90   17 %
the same with landmark threshold 0.02                          20, grows > 50   3.3 %
30 newest poses eliminated last, thresholds as below           12, flat to 300  0.8 %
=============================================================  ===============  ==================

By default iSAM2 eliminates last whatever the new factors touch: here the 250 landmarks in view, so that its root is a
dense block of some 800 columns. Naming the newest poses instead leaves the landmarks to go first, where each is a
clique of its own.
"""

from __future__ import annotations

import re

import gtsam
import numpy as np

from backend import convert
from dualslam.core.types import FloatArray, IntArray

POSE_THRESHOLDS = (0.001, 0.005)
"""Relinearise a pose that moved by more: rotation in rad, translation in submap units (median initial depth 1)."""
POINT_THRESHOLD_MU = 0.01
N_LAST = 30
"""So many of the newest poses are eliminated last."""
GTSAM_ERRORS = (RuntimeError, ValueError, IndexError)
"""What GTSAM's C++ exceptions arrive as."""


class SolverFailure(Exception):  # noqa: N818 - caught inside backend, never leaves it
    """The solver threw or died; `key` is the variable that it named, if any."""

    def __init__(self, message: str, key: int | None = None) -> None:
        super().__init__(message)
        self.key = key

    @classmethod
    def of(cls, error: Exception) -> SolverFailure:
        """Make one of an exception of GTSAM, whose text may name a variable."""
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        message = " ".join(lines[:2])[:200] if lines else type(error).__name__
        found = re.search(r"variable\s+(\d+)", str(error))
        return cls(message, int(found.group(1)) if found else None)


class IncrementalSolver:
    """One `gtsam.ISAM2`. After a `SolverFailure` it must be thrown away."""

    def __init__(self) -> None:
        thresholds = gtsam.ISAM2ThresholdMap()
        rotation_rad, translation_mu = POSE_THRESHOLDS
        thresholds.insert(("x", np.array([rotation_rad] * 3 + [translation_mu] * 3)))
        thresholds.insert((chr(0), np.full(3, POINT_THRESHOLD_MU)))  # plain-int keys have the character 0
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(thresholds)
        params.relinearizeSkip = 1
        params.enablePartialRelinearizationCheck = True
        self._isam = gtsam.ISAM2(params)

    def update(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, remove: list[int], newest: list[int]
    ) -> IntArray:
        """Add and remove factors, solve, and return the indices of the new factors in the order of `graph`.

        Parameters
        ----------
        graph : NonlinearFactorGraph
        values : Values
            Of the variables that are new.
        remove : list of int
            Factor indices.
        newest : list of int
            Keyframes to eliminate last.
        """
        params = gtsam.ISAM2UpdateParams()
        params.removeFactorIndices = remove
        last = gtsam.KeyGroupMap()
        for k in newest:
            last.insert2(convert.pose_key(k), 1)
        params.constrainedKeys = last
        try:
            result = self._isam.update(graph, values, params)
            cliques, indices = result.getCliques(), result.getNewFactorsIndices()
        except GTSAM_ERRORS as error:
            raise SolverFailure.of(error) from error
        if cliques == 0:
            raise SolverFailure("the solver is dead (no cliques)")
        return np.asarray(indices, np.int64)

    def pose(self, keyframe_id: int) -> FloatArray:
        """Return the (4, 4) estimate of one pose."""
        try:
            return convert.from_pose3(self._isam.calculateEstimatePose3(convert.pose_key(keyframe_id)))
        except GTSAM_ERRORS as error:
            raise SolverFailure.of(error) from error

    def estimate(self, keyframes: IntArray, landmarks: IntArray, everything: bool) -> tuple[FloatArray, FloatArray]:
        """Return (K, 4, 4) poses and (L, 3) points of ascending ids; `everything` says that they are all there are."""
        try:
            if everything:
                values = self._isam.calculateEstimate()
            else:
                values = self._isam.calculateEstimate(landmarks.tolist() + convert.pose_keys(keyframes))
            T, xyz = convert.poses_of(values), convert.points_of(values)
        except GTSAM_ERRORS as error:
            raise SolverFailure.of(error) from error
        if len(T) != len(keyframes) or len(xyz) != len(landmarks):
            raise SolverFailure(
                f"the solver holds {len(T)} poses and {len(xyz)} points where {len(keyframes)} and {len(landmarks)} "
                "were expected"
            )
        if not (np.isfinite(T).all() and np.isfinite(xyz).all()):
            raise SolverFailure("the estimate is not finite")
        return T, xyz

    def has(self, key: int) -> bool:
        """Return whether a variable is there."""
        return bool(self._isam.valueExists(key))

    def covariance(self, key: int) -> FloatArray:
        """Return the marginal covariance of one variable."""
        try:
            return np.asarray(self._isam.marginalCovariance(key), float)
        except GTSAM_ERRORS as error:
            raise SolverFailure.of(error) from error


def optimise_batch(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, keyframes: IntArray, landmarks: IntArray, iterations: int
) -> tuple[FloatArray, FloatArray]:
    """Run Levenberg-Marquardt, points eliminated first; return (K, 4, 4) poses and (L, 3) points of ascending ids."""
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(iterations)
    params.setLinearSolverType("SEQUENTIAL_CHOLESKY")
    params.setOrdering(gtsam.Ordering(landmarks.tolist() + convert.pose_keys(keyframes)))
    try:
        result = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
        T, xyz = convert.poses_of(result), convert.points_of(result)
    except GTSAM_ERRORS as error:
        raise SolverFailure.of(error) from error
    if not (np.isfinite(T).all() and np.isfinite(xyz).all()):
        raise SolverFailure("the batch estimate is not finite")
    return T, xyz
