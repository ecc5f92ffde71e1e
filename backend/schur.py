"""Batch bundle adjustment of a whole submap in numpy, by the Schur complement of its points.

The reduced system of the poses is a band matrix in a reordering of them: narrow for a map that moves on, full for one
that stays in a room. Observations are linearised in chunks, so that memory grows with the band alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import bsr_array, csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from dualslam.backend.observability import projection_jacobian, reproject
from dualslam.backend.point_refinement import normal_equations
from dualslam.core.bundle import BundleProblem
from dualslam.core.errors import SolverError
from dualslam.core.geometry import se3, so3
from dualslam.core.sums import sum_by
from dualslam.core.types import FloatArray, IntArray

Loss = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Weights and losses of squared whitened residuals."""
CHUNK = 8192
"""Observations that are linearised at once, about 1 kB each."""
FIRST_DAMPING, DAMPING_FACTOR, MOST_DAMPING = 1e-5, 10.0, 1e5
"""Levenberg-Marquardt, added to the diagonal: as GTSAM's."""
BEHIND_CHI2 = 1e6
"""What a view of a point behind its camera counts as: the loss is large, and the weight none."""


@dataclass(frozen=True, slots=True, eq=False)
class Optimum:
    """Where the optimisation ended.

    Attributes
    ----------
    T_submap_kf : (F, 4, 4)
    xyz_mu : (P, 3)
    cost_before, cost_after : float
        Sum of the losses.
    """

    T_submap_kf: FloatArray
    xyz_mu: FloatArray
    cost_before: float
    cost_after: float


@dataclass(frozen=True, slots=True, eq=False)
class _Linear:
    """The observations of a chunk, linearised.

    Attributes
    ----------
    pose, point : (R,) int64
        Among the free poses, -1 for a fixed one; among the chunk's points.
    residuals : (R, 2)
        Whitened.
    weight : (R,)
    J_pose : (R, 2, 6), J_point : (R, 2, 3)
    """

    pose: IntArray
    point: IntArray
    residuals: FloatArray
    weight: FloatArray
    J_pose: FloatArray
    J_point: FloatArray


def geman_mcclure(chi2: FloatArray, shape: float) -> tuple[FloatArray, FloatArray]:
    """Return weights and losses: far beyond `shape` sigmas a residual no longer counts."""
    share = shape**2 / (shape**2 + chi2)
    return share**2, 0.5 * chi2 * share


def optimise(problem: BundleProblem, loss: Loss, max_iterations: int, tolerance: float) -> Optimum:
    """Run Levenberg-Marquardt on the poses that are not fixed, and on all points.

    Parameters
    ----------
    problem : BundleProblem
        Each point has two views or more that tell its depth.
    loss : callable
    max_iterations : int
    tolerance : float
        Relative decrease of the cost below which to stop.

    Raises
    ------
    SolverError
        If no damping makes the system definite, or a residual is not finite.
    """
    system = _System(problem, loss)
    T, xyz = problem.T_submap_kf, problem.xyz_mu
    before = cost = system.cost(T, xyz)
    damping, n_definite = FIRST_DAMPING, 0
    for _ in range(max_iterations):
        gain = 0.0
        while not gain > 0 and damping <= MOST_DAMPING:
            moved = system.step(T, xyz, damping)
            if moved is not None and (new := system.cost(*moved)) < cost:
                (T, xyz), gain, cost = moved, cost - new, new
                damping /= DAMPING_FACTOR
            else:
                damping *= DAMPING_FACTOR
            n_definite += moved is not None
        if not gain > tolerance * cost:
            break
    if not n_definite or not np.isfinite(before):
        raise SolverError(f"bundle adjustment of {len(T)} poses and {len(xyz)} points has no optimum")
    return Optimum(T, xyz, before, cost)


class _System:
    """The normal equations of a problem."""

    def __init__(self, problem: BundleProblem, loss: Loss) -> None:
        self._problem, self._loss = problem, loss
        self._rows = np.argsort(problem.point, kind="stable")
        n_views = np.bincount(problem.point, minlength=len(problem.xyz_mu))
        self._begin = np.concatenate([[0], np.cumsum(n_views)])  # of each point, among the rows
        self._chunks = list(self._in_chunks())
        free = np.flatnonzero(~problem.fixed)
        place = np.full(len(problem.fixed), -1)
        place[free] = np.arange(len(free))
        seen = place[problem.kf] >= 0
        sees = csr_array(
            (np.ones(seen.sum(), np.int32), (place[problem.kf[seen]], problem.point[seen])),
            shape=(len(free), len(problem.xyz_mu)),
        )
        shares = csr_array(sees @ sees.T)
        order = reverse_cuthill_mckee(shares, symmetric_mode=True)
        self._free = free[order]  # the order of the reduced system
        place[self._free] = np.arange(len(free))
        self._place = place
        i, j = (place[free[each]] for each in shares.nonzero())
        self._band = int(np.abs(i - j).max(initial=0))

    def _in_chunks(self) -> Iterator[tuple[int, int]]:
        """Yield points that have `CHUNK` views together, or a few more: the first one, and the one after the last."""
        first, n = 0, len(self._begin) - 1
        while first < n:
            last = int(np.searchsorted(self._begin, self._begin[first] + CHUNK))
            yield first, min(max(last, first + 1), n)
            first = last

    def cost(self, T: FloatArray, xyz: FloatArray) -> float:
        """Return the sum of the losses."""
        return sum(float(self._fit(chunk, T, xyz)[3].sum()) for chunk in self._chunks)

    def _fit(
        self, chunk: tuple[int, int], T: FloatArray, xyz: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return points in their cameras (R, 3), whitened residuals (R, 2), weights and losses (R,)."""
        p, rows = self._problem, self._rows_of(chunk)
        xyz_cam, front, uv_px = reproject(p.K, T, p.kf[rows], xyz.take(p.point[rows], axis=0))
        residuals = (uv_px - p.uv_px[rows]) / p.sigma_px[rows, None]
        chi2 = np.where(front, np.einsum("ri,ri->r", residuals, residuals), BEHIND_CHI2)
        weight, losses = self._loss(chi2)
        return np.where(front[:, None], xyz_cam, [0.0, 0.0, 1.0]), residuals, np.where(front, weight, 0.0), losses

    def _rows_of(self, chunk: tuple[int, int]) -> IntArray:
        return self._rows[self._begin[chunk[0]] : self._begin[chunk[1]]]

    def _linearise(self, chunk: tuple[int, int], T: FloatArray, xyz: FloatArray) -> _Linear:
        p, rows = self._problem, self._rows_of(chunk)
        xyz_cam, residuals, weight, _ = self._fit(chunk, T, xyz)
        R = T.take(p.kf[rows], axis=0)[:, :3, :3]
        J_point = projection_jacobian(p.K, R, xyz_cam, p.sigma_px[rows]).transpose(2, 0, 1)
        J_cam = J_point @ R  # by the pose: in the camera, a point moves by [p]x omega - v
        J_pose = np.concatenate((J_cam @ so3.hat(xyz_cam), -J_cam), axis=2)
        return _Linear(self._place[p.kf[rows]], p.point[rows] - chunk[0], residuals, weight, J_pose, J_point)

    def step(self, T: FloatArray, xyz: FloatArray, damping: float) -> tuple[FloatArray, FloatArray] | None:
        """Return poses and points moved by one damped step; None where the system is not definite."""
        n = len(self._free)
        blocks = np.zeros((n, self._band + 1, 6, 6))  # [j, d]: rows of pose j + d, columns of pose j
        gradient, points = np.zeros((n, 6)), []
        try:
            for chunk in self._chunks:
                linear = self._linearise(chunk, T, xyz)
                points.append(self._eliminate(linear, chunk[1] - chunk[0], damping, blocks, gradient))
            factor = cholesky_banded(_band_matrix(blocks, damping), overwrite_ab=True, lower=True, check_finite=False)
        except np.linalg.LinAlgError:
            return None
        del blocks
        xi = cho_solve_banded((factor, True), -gradient.ravel(), check_finite=False).reshape(n, 6)
        moved = xyz.copy()
        for (first, last), (V_inverse, g) in zip(self._chunks, points, strict=True):
            linear = self._linearise((first, last), T, xyz)
            seen = linear.pose >= 0
            shift = np.einsum("rij,rj->ri", linear.J_pose[seen], xi[linear.pose[seen]]) * linear.weight[seen, None]
            by_pose = np.einsum("rij,ri->rj", linear.J_point[seen], shift)
            g = g + sum_by(linear.point[seen], by_pose, last - first)
            moved[first:last] -= np.einsum("pij,pj->pi", V_inverse, g)
        T_moved = T.copy()
        T_moved[self._free] = T[self._free] @ se3.exp(xi)
        return T_moved, moved

    def _eliminate(
        self, linear: _Linear, n_points: int, damping: float, blocks: FloatArray, gradient: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Add what a chunk tells of the poses; return the points' inverse information (P, 3, 3) and gradient (P, 3)."""
        n = len(gradient)
        V, g = normal_equations(
            linear.J_point.transpose(1, 2, 0), linear.weight, linear.residuals, linear.point, n_points
        )
        V_inverse = np.asarray(np.linalg.inv(V + damping * np.eye(3)), np.float64)
        root = np.linalg.cholesky(V_inverse)
        by_pose = np.argsort(linear.pose, kind="stable")
        by_pose = by_pose[np.searchsorted(linear.pose[by_pose], 0) :]  # not the fixed ones
        pose, point, J = linear.pose[by_pose], linear.point[by_pose], linear.J_pose[by_pose]
        weighted = np.ascontiguousarray(J.transpose(0, 2, 1)) * linear.weight[by_pose, None, None]
        Y = weighted @ linear.J_point[by_pose] @ root[point]
        own = np.einsum("rij,rj->ri", weighted, linear.residuals[by_pose])
        own -= np.einsum("rij,rj->ri", Y, np.einsum("pji,pj->pi", root, g)[point])
        gradient += sum_by(pose, own, n)
        blocks[:, 0] += sum_by(pose, (weighted @ J).reshape(-1, 36), n).reshape(n, 6, 6)
        ends = np.searchsorted(pose, np.arange(n + 1))
        tied = bsr_array((Y, point, ends), shape=(6 * n, 3 * n_points))
        product = tied @ tied.T
        row, column = np.repeat(np.arange(n), np.diff(product.indptr)), product.indices
        lower = row >= column
        blocks[column[lower], (row - column)[lower]] -= product.data[lower]
        return V_inverse, g


def _band_matrix(blocks: FloatArray, damping: float) -> FloatArray:
    """Return LAPACK's lower band storage of blocks (N, B + 1, 6, 6), each at [column, row - column]."""
    n, width = blocks.shape[:2]
    band = np.zeros((6 * width, 6 * n), order="F")
    for a in range(6):
        for b in range(6):
            first = int(a < b)  # what is above the diagonal is left out
            begin = 6 * first + a - b
            band[begin::6, b::6][: width - first] = blocks[:, first:, a, b].T
    band[0] += damping
    return band
