"""iSAM2 and batch Levenberg-Marquardt behind calls that raise one kind of failure and never hand on a dead solver.

By default iSAM2 eliminates last whatever the new factors touch: the landmarks in view, so that its root is a dense
block of some 800 columns. Naming the newest poses instead leaves the landmarks to go first, each a clique of its own.
``enablePartialRelinearizationCheck``, which stops at the first clique that stands still, no longer reaches them. All
variables are therefore checked, but not each time (docs/notes/2026-11-28-isam2-newest-poses-last.md).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import gtsam
import numpy as np

from dualslam.backend import convert
from dualslam.core.types import FloatArray, IntArray

POSE_THRESHOLDS = (0.0015, 0.0075)
"""Relinearise a pose that moved by more: rotation in rad, translation in submap units (median initial depth 1)."""
POINT_THRESHOLD_MU = 0.02
N_LAST = 30
"""So many of the newest poses are eliminated last."""
GTSAM_ERRORS = (RuntimeError, ValueError, IndexError)
"""Python types of GTSAM's C++ exceptions."""


class SolverFailure(Exception):  # noqa: N818 - caught inside backend, never leaves it
    """The solver threw or died; `key` is the variable that it named, if any."""

    def __init__(self, message: str, key: int | None = None) -> None:
        super().__init__(message)
        self.key = key

    @classmethod
    def of(cls, error: Exception) -> SolverFailure:
        """Make one of an exception of GTSAM, whose text may name a variable."""
        found = re.search(r"variable\s+(\d+)", str(error))
        key = int(found.group(1)) if found else None
        if key is not None and "ndeterminate" in str(error):
            kind, number = ("keyframe", convert.keyframe_of(key)) if convert.is_pose_key(key) else ("landmark", key)
            return cls(f"nothing fixes {kind} {number}, or others that hang on it", key)
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        return cls(" ".join(lines[:2])[:200] if lines else type(error).__name__, key)


@contextmanager
def naming_failure() -> Iterator[None]:
    """Raise what GTSAM raises as a `SolverFailure`."""
    try:
        yield
    except GTSAM_ERRORS as error:
        raise SolverFailure.of(error) from error


class IncrementalSolver:
    """One `gtsam.ISAM2`. After a `SolverFailure` it must be thrown away."""

    def __init__(self) -> None:
        thresholds = gtsam.ISAM2ThresholdMap()
        rotation_rad, translation_mu = POSE_THRESHOLDS
        thresholds.insert(("x", np.array([rotation_rad] * 3 + [translation_mu] * 3)))
        thresholds.insert((chr(0), np.full(3, POINT_THRESHOLD_MU)))  # plain-int keys have the character 0
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(thresholds)
        params.relinearizeSkip = 1 << 30  # the caller says when
        params.enablePartialRelinearizationCheck = False
        self._isam = gtsam.ISAM2(params)
        self.statistics = UpdateStatistics(0, 0)
        """Of the last step."""

    def update(
        self,
        graph: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        remove: list[int],
        newest: list[int],
        relinearise: bool,
    ) -> IntArray:
        """Add and remove factors, solve, and return the indices of the new factors in the order of `graph`.

        - `values`: of the variables that are new.
        - `remove`: factor indices.
        - `newest`: keyframes to eliminate last.
        - `relinearise`: whether variables that moved beyond their threshold get a new linearisation.
        """
        params = gtsam.ISAM2UpdateParams()
        params.removeFactorIndices = remove
        last = gtsam.KeyGroupMap()
        for k in newest:
            last.insert2(convert.pose_key(k), 1)
        params.constrainedKeys = last
        params.force_relinearize = relinearise
        with naming_failure():
            result = self._isam.update(graph, values, params)
            cliques, indices = result.getCliques(), result.getNewFactorsIndices()
        if cliques == 0:
            raise SolverFailure("the solver is dead (no cliques)")
        self.statistics = UpdateStatistics(
            int(result.getVariablesRelinearized()), int(result.getVariablesReeliminated())
        )
        return np.asarray(indices, np.int64)

    def pose(self, keyframe_id: int) -> FloatArray:
        """Return the (4, 4) estimate of one pose."""
        with naming_failure():
            return convert.from_pose3(self._isam.calculateEstimatePose3(convert.pose_key(keyframe_id)))

    def estimate(self, keyframes: IntArray, landmarks: IntArray, everything: bool) -> tuple[FloatArray, FloatArray]:
        """Return (K, 4, 4) poses and (L, 3) points of ascending ids; `everything` says that they are all there are."""
        with naming_failure():
            if everything:
                values = self._isam.calculateEstimate()
            else:
                values = self._isam.calculateEstimate(landmarks.tolist() + convert.pose_keys(keyframes))
            T, xyz = convert.poses_of(values), convert.points_of(values)
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

    def bayes_tree(self) -> BayesTree:
        """Return the current tree."""
        with naming_failure():
            return parse_bayes_tree(self._isam.dot())

    def covariance(self, key: int) -> FloatArray:
        """Return the marginal covariance of one variable."""
        with naming_failure():
            return np.asarray(self._isam.marginalCovariance(key), float)


@dataclass(frozen=True, slots=True, eq=False)
class BatchOptimum:
    """Result of `optimise_batch`: poses (K, 4, 4) and points (L, 3) of ascending ids, and costs."""

    T_submap_kf: FloatArray
    xyz_mu: FloatArray
    cost_before: float
    cost_after: float


def optimise_batch(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    keyframes: IntArray,
    landmarks: IntArray,
    max_iterations: int,
    tolerance: float = 1e-5,
) -> BatchOptimum:
    """Run Levenberg-Marquardt on poses and points, the points eliminated first.

    - `keyframes` (K,), `landmarks` (L,).
    - `values`: of exactly the poses of `keyframes` and the points of `landmarks`, both ascending.
    - `tolerance`: relative decrease of the cost below which to stop.
    """
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(max_iterations)
    params.setRelativeErrorTol(tolerance)
    params.setLinearSolverType("SEQUENTIAL_CHOLESKY")
    params.setOrdering(gtsam.Ordering(landmarks.tolist() + convert.pose_keys(keyframes)))
    with naming_failure():
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
        before = float(optimizer.error())
        result = optimizer.optimize()
        if optimizer.iterations() == 0 and optimizer.lambda_() >= params.getlambdaUpperBound():
            # No step was good. Where the baseline that fixes the scale must turn, its factor (1e-4 of its length) bears
            # small steps alone. Its poses have 1e8 and more on the diagonal, beside which no damping counted.
            params.setDiagonalDamping(True)
            optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
            result = optimizer.optimize()
        T, xyz = convert.poses_of(result), convert.points_of(result)
        after = float(optimizer.error())
    if not (np.isfinite(T).all() and np.isfinite(xyz).all()):
        raise SolverFailure("the batch estimate is not finite")
    return BatchOptimum(T, xyz, before, after)


_NODE = re.compile(r'^(\d+)\[label="([^"]*)"\];$')
_EDGE = re.compile(r"^(\d+)->(\d+)$")


@dataclass(frozen=True, slots=True)
class UpdateStatistics:
    """Effect of one step of the incremental solver."""

    relinearised: int  # variables that had moved beyond their threshold and got a new linearisation
    reeliminated: int  # variables whose conditional was computed anew


@dataclass(frozen=True, slots=True, eq=False)
class BayesTree:
    """The square-root information matrix as a tree: each clique is p(frontal variables | separator)."""

    parent: IntArray
    """(C,): clique above each one, -1 for a root. Parents come before their children."""
    # Frontal variables of each clique.
    keyframes: tuple[tuple[int, ...], ...]
    landmarks: tuple[tuple[int, ...], ...]
    separators: tuple[tuple[int, ...], ...]
    """Keyframes that each clique is conditioned on; they are frontal somewhere above it."""
    separator_landmarks: IntArray  # (C,): how many landmarks it is conditioned on besides

    def __len__(self) -> int:
        return len(self.parent)

    @property
    def depth(self) -> IntArray:
        """(C,) number of cliques above each one."""
        depth = np.zeros(len(self), np.int64)
        for clique, above in enumerate(self.parent.tolist()):
            depth[clique] = 0 if above < 0 else depth[above] + 1
        return depth


def parse_bayes_tree(dot: str) -> BayesTree:
    """Read the text that `gtsam.ISAM2.dot` writes: the tree itself is not within reach from Python."""
    labels: dict[str, str] = {}
    above: dict[str, str] = {}
    for line in dot.splitlines():
        if node := _NODE.match(line.strip()):
            labels[node.group(1)] = node.group(2)
        elif edge := _EDGE.match(line.strip()):
            above[edge.group(2)] = edge.group(1)
    children: dict[str, list[str]] = {}
    for name in labels:
        children.setdefault(above.get(name, ""), []).append(name)
    ordered: list[str] = []
    waiting = list(reversed(children.get("", [])))
    while waiting:
        name = waiting.pop()
        ordered.append(name)
        waiting += reversed(children.get(name, []))
    row = {name: i for i, name in enumerate(ordered)}
    variables = [[_split(part) for part in (labels[name] + ":").split(":")[:2]] for name in ordered]
    return BayesTree(
        parent=np.array([row[above[name]] if name in above else -1 for name in ordered], np.int64),
        keyframes=tuple(frontal[0] for frontal, _ in variables),
        landmarks=tuple(frontal[1] for frontal, _ in variables),
        separators=tuple(separator[0] for _, separator in variables),
        separator_landmarks=np.array([len(separator[1]) for _, separator in variables], np.int64),
    )


def _split(variables: str) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return keyframes (``x3``) and landmarks (``12``) of a list of variables."""
    names = [name.strip() for name in variables.split(",") if name.strip()]
    keyframes = tuple(int(name[1:]) for name in names if name.startswith("x"))
    return keyframes, tuple(int(name) for name in names if not name.startswith("x"))
