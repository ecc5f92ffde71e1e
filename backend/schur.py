"""Batch bundle adjustment of a whole submap in numpy, by the Schur complement of its points.

The reduced system of the poses is a band matrix in a reordering of them: narrow for a map that moves on, full for one
that stays in a room. Observations are linearised in chunks, so that memory grows with the band alone. A lens that all
poses share may be a variable, too: its few columns border the band.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import bsr_array, csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from dualslam.backend.observability import projection_jacobian, reproject
from dualslam.backend.point_refinement import normal_equations
from dualslam.core.arrays import sum_by
from dualslam.core.bundle import BundleProblem
from dualslam.core.errors import SolverError
from dualslam.core.geometry import se3, so3
from dualslam.core.types import FloatArray, IntArray

Loss = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Weights and losses of squared whitened residuals."""
_Fit = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Of a chunk's observations: points in their cameras (R, 3), whitened residuals (R, 2), weights and losses (R,)."""
CHUNK, KEPT_CHUNKS = 8192, 4
"""Observations that are linearised at once, about 1 kB each. Up to so many chunks are kept through a step, 0.3 kB an
observation; more are linearised twice."""
FIRST_DAMPING, DAMPING_FACTOR, LEAST_DAMPING, MOST_DAMPING = 1e-5, 10.0, 1e-8, 1e10
"""Levenberg-Marquardt, added to the diagonal."""
BEHIND_CHI2 = 1e6
"""What a view of a point behind its camera counts as: the loss is large, and the weight none. Were it small, cameras
would fit best that have turned away from all points."""


class Lens(Protocol):
    """A lens of M parameters, with a prior at zero."""

    information: FloatArray  # (M, M), of the prior

    def project(self, xy: FloatArray, parameters: FloatArray) -> FloatArray:
        """Return the pixels (R, 2) of rays (x, y, 1), (R, 2)."""
        ...

    def derivatives(self, xy: FloatArray, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return how pixels change with the rays (R, 2, 2) and with the parameters (R, 2, M)."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Values of the variables: poses (F, 4, 4), points (P, 3), parameters of the lens (M,)."""

    T_submap_kf: FloatArray
    xyz_mu: FloatArray
    lens: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Optimum:
    """Where the optimisation ended."""

    state: State
    # Sum of the losses.
    cost_before: float
    cost_after: float


@dataclass(frozen=True, slots=True, eq=False)
class _Linear:
    """The observations of a chunk, linearised."""

    # Among the free poses, -1 for a fixed one; among the chunk's points.
    pose: IntArray  # (R,)
    point: IntArray  # (R,)
    residuals: FloatArray  # (R, 2): whitened
    weight: FloatArray  # (R,)
    J_pose: FloatArray  # (R, 2, 6)
    J_point: FloatArray  # (R, 2, 3)
    J_lens: FloatArray  # (R, 2, M)


@dataclass(slots=True, eq=False)
class _Reduced:
    """Normal equations without the points, in sums over the chunks."""

    blocks: FloatArray  # (N, B + 1, 6, 6): at [j, d]: rows of pose j + d, columns of pose j
    # Rows and columns of the lens.
    border: FloatArray  # (N, 6, M)
    corner: FloatArray  # (M, M)
    # The gradient.
    g_pose: FloatArray  # (N, 6)
    g_lens: FloatArray  # (M,)


def geman_mcclure(chi2: FloatArray, shape: float) -> tuple[FloatArray, FloatArray]:
    """Return weights and losses: far beyond `shape` sigmas a residual no longer counts."""
    share = shape**2 / (shape**2 + chi2)
    return share**2, chi2 / 2 * share


def optimise(
    problem: BundleProblem,
    loss: Loss,
    max_iterations: int,
    tolerance: float,
    lens: Lens | None = None,
    parameters: FloatArray | None = None,
) -> Optimum:
    """Run Levenberg-Marquardt on the poses that are not fixed, and on all points.

    - `problem`: each point has two views or more that tell its depth.
    - `tolerance`: relative decrease of the cost below which to stop.
    - `lens`: one more variable, instead of ``problem.K``.
    - `parameters` (M,): of the lens, to begin with.

    Raises `SolverError` if no damping makes the system definite, or a residual is not finite.
    """
    system = System(problem, loss, lens)
    state = State(problem.T_submap_kf, problem.xyz_mu, np.zeros(0) if parameters is None else parameters)
    before = cost = system.cost(state)
    damping, n_definite = FIRST_DAMPING, 0
    for _ in range(max_iterations):
        gain = 0.0
        while not gain > 0 and damping <= MOST_DAMPING:
            moved = system.step(state, damping)
            if moved is not None and (new := system.cost(moved)) < cost:
                state, gain, cost = moved, cost - new, new
                damping = max(damping / DAMPING_FACTOR, LEAST_DAMPING)
            else:
                damping *= DAMPING_FACTOR
            n_definite += moved is not None
        if not gain > tolerance * cost:
            break
    if not n_definite or not np.isfinite(before):
        n, m = len(problem.T_submap_kf), len(problem.xyz_mu)
        raise SolverError(f"bundle adjustment of {n} poses and {m} points has no optimum")
    return Optimum(state, before, cost)


class System:
    """The normal equations of a problem."""

    def __init__(self, problem: BundleProblem, loss: Loss, lens: Lens | None = None) -> None:
        self._problem, self._loss, self._lens = problem, loss, lens
        self._fitted: tuple[State, list[_Fit]] | None = None
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
        order = reverse_cuthill_mckee(shares, symmetric_mode=True) if len(free) else free
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

    def cost(self, state: State) -> float:
        """Return the sum of the losses, and the prior's."""
        prior = 0.0 if self._lens is None else float(state.lens @ self._lens.information @ state.lens) / 2
        return prior + sum(float(losses.sum()) for *_, losses in self._fits(state))

    def _fits(self, state: State) -> Iterable[_Fit]:
        """Fit all chunks. A state whose cost was asked for last is the one that is linearised next: its fit is kept."""
        if self._fitted is None or self._fitted[0] is not state:
            fits = (self._fit(chunk, state) for chunk in self._chunks)
            if len(self._chunks) > KEPT_CHUNKS:
                return fits
            self._fitted = state, list(fits)
        return self._fitted[1]

    def _fit(self, chunk: tuple[int, int], state: State) -> _Fit:
        p, rows = self._problem, self._rows_of(chunk)
        xyz_cam, front, uv_px = reproject(p.K, state.T_submap_kf, p.kf[rows], state.xyz_mu.take(p.point[rows], axis=0))
        xyz_cam = np.where(front[:, None], xyz_cam, [0.0, 0.0, 1.0])
        if self._lens is not None:
            uv_px = self._lens.project(xyz_cam[:, :2] / xyz_cam[:, 2:], state.lens)
        residuals = (uv_px - p.uv_px[rows]) / p.sigma_px[rows, None]
        chi2 = np.where(front, np.einsum("ri,ri->r", residuals, residuals), BEHIND_CHI2)
        weight, losses = self._loss(chi2)
        return xyz_cam, residuals, np.where(front, weight, 0.0), losses

    def _rows_of(self, chunk: tuple[int, int]) -> IntArray:
        return self._rows[self._begin[chunk[0]] : self._begin[chunk[1]]]

    def _linearise(self, chunk: tuple[int, int], state: State, fit: _Fit) -> _Linear:
        p, rows = self._problem, self._rows_of(chunk)
        xyz_cam, residuals, weight, _ = fit
        R, sigma_px = se3.rotation(state.T_submap_kf.take(p.kf[rows], axis=0)), p.sigma_px[rows]
        if self._lens is None:
            J_point = projection_jacobian(p.K, R, xyz_cam, sigma_px).transpose(2, 0, 1)
            J_cam = J_point @ R
            J_lens = np.zeros((len(rows), 2, 0))
        else:
            xy, z = xyz_cam[:, :2] / xyz_cam[:, 2:], xyz_cam[:, 2]
            by_ray, by_lens = self._lens.derivatives(xy, state.lens)
            by_ray = by_ray / (z * sigma_px)[:, None, None]
            J_cam = np.concatenate((by_ray, -(by_ray @ xy[:, :, None])), axis=2)
            J_point, J_lens = J_cam @ R.transpose(0, 2, 1), by_lens / sigma_px[:, None, None]
        # By the pose: in the camera, a point moves by [p]x omega - v.
        J_pose = np.concatenate((J_cam @ so3.hat(xyz_cam), -J_cam), axis=2)
        return _Linear(self._place[p.kf[rows]], p.point[rows] - chunk[0], residuals, weight, J_pose, J_point, J_lens)

    def step(self, state: State, damping: float) -> State | None:
        """Return the variables moved by one damped step (poses by ``T exp(xi)``); None where nothing is definite."""
        kept = self._linear(state)
        linear = list(kept) if len(self._chunks) <= KEPT_CHUNKS else None
        reduced, points = self._without_points(state, damping, kept if linear is None else linear)
        solved = None if reduced is None else self._solve(reduced, damping)
        if reduced is None or solved is None:
            return None
        xi, by_lens, corner, g_lens = solved
        d_lens = -np.linalg.solve(corner, g_lens)
        xi = xi - by_lens @ d_lens
        xyz_mu = state.xyz_mu.copy()
        again = self._linear(state) if linear is None else linear
        for (first, last), chunk, (V_inverse, g) in zip(self._chunks, again, points, strict=True):
            shift, seen = chunk.J_lens @ d_lens, chunk.pose >= 0
            shift[seen] += np.einsum("rij,rj->ri", chunk.J_pose[seen], xi[chunk.pose[seen]])
            by_view = np.einsum("rij,ri->rj", chunk.J_point, shift * chunk.weight[:, None])
            g = g + sum_by(chunk.point, by_view, last - first)
            xyz_mu[first:last] -= np.einsum("pij,pj->pi", V_inverse, g)
        T = state.T_submap_kf.copy()
        T[self._free] = T[self._free] @ se3.exp(xi)
        return State(T, xyz_mu, state.lens + d_lens)

    def about_lens(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Return the marginal covariance of the lens (M, M), and how poses follow it (F, 6, M), by a state's weights.

        With a change d of the lens the cost is least at ``T exp(follows @ d)``. Raises `SolverError` if the system is
        not definite.
        """
        reduced, _ = self._without_points(state, FIRST_DAMPING, self._linear(state))
        solved = None if reduced is None else self._solve(reduced, FIRST_DAMPING)
        if solved is None:
            raise SolverError("the lens has no covariance: the system is not definite")
        follows = np.zeros((len(state.T_submap_kf), se3.DOF, len(state.lens)))
        follows[self._free] = -solved[1]
        return np.asarray(np.linalg.inv(solved[2]), np.float64), follows

    def _linear(self, state: State) -> Iterator[_Linear]:
        fits = self._fits(state)
        return (self._linearise(chunk, state, fit) for chunk, fit in zip(self._chunks, fits, strict=True))

    def _without_points(
        self, state: State, damping: float, linear: Iterable[_Linear]
    ) -> tuple[_Reduced | None, list[tuple[FloatArray, FloatArray]]]:
        """Return the reduced system, and of each chunk's points inverse information (P, 3, 3) and gradient (P, 3)."""
        n, m = len(self._free), len(state.lens)
        information = np.zeros((m, m)) if self._lens is None else self._lens.information
        reduced = _Reduced(
            np.zeros((n, self._band + 1, se3.DOF, se3.DOF)),
            np.zeros((n, se3.DOF, m)),
            information.copy(),
            np.zeros((n, se3.DOF)),
            information @ state.lens,
        )
        points = []
        try:
            for (first, last), chunk in zip(self._chunks, linear, strict=True):
                points.append(_eliminate(reduced, chunk, last - first, damping))
        except np.linalg.LinAlgError:
            return None, []
        return reduced, points

    @staticmethod
    def _solve(reduced: _Reduced, damping: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray] | None:
        """Return the poses' step (N, 6) and its change with the lens (N, 6, M), and the lens' own system."""
        n, _, m = reduced.border.shape
        if not n:
            return reduced.g_pose, reduced.border, reduced.corner, reduced.g_lens
        try:
            band = _band_matrix(reduced.blocks, damping)
            factor = cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)
        except np.linalg.LinAlgError:
            return None
        right = np.concatenate((reduced.g_pose[:, :, None], reduced.border), axis=2).reshape(se3.DOF * n, 1 + m)
        solved = cho_solve_banded((factor, True), right, check_finite=False)
        border = reduced.border.reshape(se3.DOF * n, m)
        corner = reduced.corner - border.T @ solved[:, 1:]
        g_lens = reduced.g_lens - border.T @ solved[:, 0]
        return -solved[:, 0].reshape(n, se3.DOF), solved[:, 1:].reshape(n, se3.DOF, m), corner, g_lens


def _eliminate(reduced: _Reduced, linear: _Linear, n_points: int, damping: float) -> tuple[FloatArray, FloatArray]:
    """Add what a chunk tells of poses and lens; return its points' inverse information (P, 3, 3) and gradient."""
    n = len(reduced.g_pose)
    V, g = normal_equations(linear.J_point.transpose(1, 2, 0), linear.weight, linear.residuals, linear.point, n_points)
    V_inverse = np.asarray(np.linalg.inv(V + damping * so3.IDENTITY), np.float64)
    root = np.linalg.cholesky(V_inverse)
    root_g = np.einsum("pji,pj->pi", root, g)
    weighted_lens = linear.J_lens * linear.weight[:, None, None]
    by_point = linear.J_point.transpose(0, 2, 1) @ weighted_lens  # (R, 3, M)
    Z = root.transpose(0, 2, 1) @ sum_by(linear.point, by_point, n_points)
    reduced.corner += np.tensordot(weighted_lens, linear.J_lens, ((0, 1), (0, 1)))
    reduced.corner -= np.tensordot(Z, Z, ((0, 1), (0, 1)))
    reduced.g_lens += np.tensordot(weighted_lens, linear.residuals, ((0, 1), (0, 1)))
    reduced.g_lens -= np.tensordot(Z, root_g, ((0, 1), (0, 1)))
    by_pose = np.argsort(linear.pose, kind="stable")
    by_pose = by_pose[np.searchsorted(linear.pose[by_pose], 0) :]  # not the fixed ones
    pose, point = linear.pose[by_pose], linear.point[by_pose]
    first = np.flatnonzero(np.diff(pose, prepend=-1))
    poses = pose[first]
    weighted = np.ascontiguousarray(linear.J_pose.transpose(0, 2, 1)) * linear.weight[:, None, None]
    Y = (weighted @ (linear.J_point @ root[linear.point]))[by_pose]
    own = (weighted @ linear.residuals[:, :, None])[by_pose] - Y @ root_g[point, :, None]
    reduced.g_pose[poses] += np.add.reduceat(own[:, :, 0], first)
    if linear.J_lens.shape[2]:
        border = (weighted @ linear.J_lens)[by_pose] - Y @ Z[point]
        reduced.border[poses] += np.add.reduceat(border, first)
    reduced.blocks[poses, 0] += np.add.reduceat((weighted @ linear.J_pose)[by_pose], first)
    ends = np.searchsorted(pose, np.arange(n + 1))
    tied = bsr_array((Y, point, ends), shape=(se3.DOF * n, 3 * n_points))
    product = tied @ tied.T
    row, column = np.repeat(np.arange(n), np.diff(product.indptr)), product.indices
    lower = row >= column
    reduced.blocks[column[lower], (row - column)[lower]] -= product.data[lower]
    return V_inverse, g


def _band_matrix(blocks: FloatArray, damping: float) -> FloatArray:
    """Return LAPACK's lower band storage of blocks (N, B + 1, 6, 6), each at [column, row - column]."""
    n, width = blocks.shape[:2]
    band = np.zeros((se3.DOF * width, se3.DOF * n), order="F")
    for a in range(se3.DOF):
        for b in range(se3.DOF):
            first = int(a < b)  # what is above the diagonal is left out
            begin = se3.DOF * first + a - b
            band[begin :: se3.DOF, b :: se3.DOF][: width - first] = blocks[:, first:, a, b].T
    band[0] += damping
    return band
