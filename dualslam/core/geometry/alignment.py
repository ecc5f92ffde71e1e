"""Sim(3) between two maps from matched 3D points with covariances and outliers: what links two submaps.

RANSAC over three-point Umeyama finds the consensus, Mahalanobis-weighted Gauss-Newton on the group uses what each point
is worth: a monocular point is known ten to a hundred times better across its ray than along it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from dualslam.core.chi_square import CHI2_95, CHI2_99, huber_weights
from dualslam.core.geometry import sim3, so3, symmetric3
from dualslam.core.geometry.umeyama import Alignment, umeyama, umeyama_batch
from dualslam.core.types import BoolArray, Failure, FailureReason, FloatArray

__all__ = ["Alignment", "Sim3Estimate", "estimate_sim3_robust", "umeyama", "umeyama_batch"]

COVARIANCE_INFLATION = 1.5
"""The Hessian's covariance is a little optimistic (measured): it takes the gated points for the true inliers."""
MAX_ROTATION_SIGMA_RAD = 0.2
"""A rotation known no better is not known: the inliers lie along a line as far as their covariances can tell."""
MAX_LOG_SCALE_SIGMA = 0.3
CONFIDENCE = 0.999
"""Of having drawn one clean triplet, at which RANSAC stops early."""
UNKNOWN = 100.0
"""A point that is uncertain by so many times the extent of all tells nothing, and its covariance inverts badly."""
BATCH = 64
"""Hypotheses scored at a time."""
N_REFINED = 5
"""How many of the best hypotheses are refined before one is chosen."""
SAME_BASIN = 0.9
"""Share of a hypothesis' inliers among those of a refined one at which the two are the same."""


@dataclass(frozen=True, slots=True, eq=False)
class Sim3Estimate:
    """A similarity between two maps with what supports it."""

    S_dst_src: FloatArray  # (4, 4): x -> s R x + t
    covariance: FloatArray
    """(7, 7): of xi in ``S_dst_src @ exp(xi)``: rotation (rad), translation (unit of src), log-scale; frame src. That
    is the convention of GTSAM's noise models on ``Similarity3``. `COVARIANCE_INFLATION` is included."""
    inliers: BoolArray  # (N,)
    n_iterations: int  # RANSAC hypotheses tried
    chi2_per_dof: float
    """Summed squared Mahalanobis distance of the inliers over 3 n - 7: 1 is expected, or a little less for the gate."""


class _Sim3Problem:
    """The matched points and their covariances, as the planes that the scoring works on."""

    def __init__(self, src: FloatArray, dst: FloatArray, cov_src: FloatArray, cov_dst: FloatArray) -> None:
        self.src, self.dst, self.cov_src, self.cov_dst = src, dst, cov_src, cov_dst
        self.cov_src_planes = symmetric3.planes(cov_src)
        self.cov_dst_planes = symmetric3.planes(cov_dst)

    def mahalanobis2(self, S: FloatArray) -> FloatArray:
        """Return squared Mahalanobis distances (B, N) of the residuals under B similarities (B, 4, 4)."""
        A = S[:, :3, :3]
        residual = self.dst.T[:, None] - ((A @ self.src.T).transpose(1, 0, 2) + S[:, :3, 3].T[..., None])
        # A C A' is linear in the six planes of C: one small matrix product for all points.
        i, j = symmetric3.ROWS, symmetric3.COLUMNS
        turn = A[:, i][:, :, i] * A[:, j][:, :, j] + A[:, i][:, :, j] * A[:, j][:, :, i]
        turn[:, :, i == j] *= 0.5
        covariance = (turn @ self.cov_src_planes).transpose(1, 0, 2) + self.cov_dst_planes[:, None]
        return symmetric3.quadratic_inverse(covariance, residual)

    def normal_equations(self, S: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (H (7, 7), g (7,)) of half the summed squared Mahalanobis distances, for right perturbations.

        Both sides are noisy, so the distance is that to the best true point x between the two matched ones. Its exact
        gradient has the Jacobian at x. With the Jacobian at src and the covariance held, the scale is biased and
        swapping the maps does not invert the estimate. (Errors in variables, regression dilution.)
        """
        J, WJ, residual = self.linearise(S, weight)
        WJ = WJ.reshape(-1, 7)
        H = J.reshape(-1, 7).T @ WJ
        return 0.5 * (H + H.T), WJ.T @ residual.reshape(-1)

    def linearise(self, S: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the Jacobians (N, 3, 7), the same times the pairs' information, and the residuals (N, 3)."""
        A = S[:3, :3]
        residual = self.dst - (self.src @ A.T + S[:3, 3])
        covariance = self.cov_dst + A @ self.cov_src @ A.T
        adj, det = symmetric3.adjugate(symmetric3.planes(covariance))
        information = symmetric3.matrices(adj * (weight / det))
        pull = (information @ residual[..., None])[..., 0]
        unweighted = np.where(weight > 0, weight, 1.0)[:, None]
        x = self.src + (self.cov_src @ A.T @ (pull / unweighted)[..., None])[..., 0]
        # S exp(xi) x - S x = A (w x x + u + l x).
        J = np.empty((len(x), 3, 7))
        J[:, :, :3] = A @ so3.hat(-x)
        J[:, :, 3:6] = A
        J[:, :, 6] = x @ A.T
        return J, information @ J, residual


def sensitivity(
    S_dst_src: FloatArray, src: FloatArray, dst: FloatArray, cov_src: FloatArray, cov_dst: FloatArray
) -> FloatArray:
    """Return the derivatives (N, 7, 3) of an estimated similarity, as xi in ``S_dst_src @ exp(xi)``, by points of dst.

    Arguments as for `estimate_sim3_robust`: its inliers. By points of src they are these times ``-s R``.
    """
    problem = _Sim3Problem(src, dst, cov_src, cov_dst)
    J, WJ, _ = problem.linearise(S_dst_src, np.ones(len(src)))
    H = np.einsum("nia,nib->ab", J, WJ)
    return np.asarray(np.linalg.solve(H, WJ.transpose(0, 2, 1)))


def estimate_sim3_robust(
    src: FloatArray,
    dst: FloatArray,
    cov_src: FloatArray,
    cov_dst: FloatArray,
    rng: Generator,
    *,
    min_inliers: int = 10,
    max_hypotheses: int = 512,
    chi2_gate: float = CHI2_99[3],
    scale_bounds: tuple[float, float] = (1e-3, 1e3),
) -> Sim3Estimate | Failure:
    """Estimate the similarity between two maps from matched points, some of them wrong.

    - `src`, `dst` (N, 3): matched points, each in its map's frame and unit.
    - `cov_src`, `cov_dst` (N, 3, 3): their covariances. Pairs with a value that is not finite are never inliers. Nor is
      a point known no better than to `UNKNOWN` times the extent of all.
    - `rng`: the only source of randomness.
    - `min_inliers`: fewer are a failure.
    - `max_hypotheses`: RANSAC stops here at the latest.
    - `chi2_gate`: of the squared Mahalanobis distance under ``cov_dst + s^2 R cov_src R'``.
    - `scale_bounds`: scales outside are a failure.

    Returns Sim3Estimate or Failure: `TOO_FEW_MATCHES`, `TOO_FEW_INLIERS`, `DEGENERATE` (collinear, or a rotation that
    the covariances leave open) or `SCALE` (out of bounds, or left open).
    """
    finite = np.isfinite(np.concatenate([src, dst, cov_src.reshape(-1, 9), cov_dst.reshape(-1, 9)], 1)).all(1)
    rows = np.flatnonzero(finite)
    rows = rows[_is_known(src[rows], cov_src[rows]) & _is_known(dst[rows], cov_dst[rows])]
    n = len(rows)
    if n < max(min_inliers, 3):
        return Failure(FailureReason.TOO_FEW_MATCHES, f"{n} matches, {min_inliers} needed", {"n": float(n)})
    problem = _Sim3Problem(src[rows], dst[rows], cov_src[rows], cov_dst[rows])
    hypotheses, n_tried = _ransac(problem, rng, chi2_gate, max_hypotheses, scale_bounds)
    if not len(hypotheses):
        return Failure(FailureReason.DEGENERATE, f"no triplet of {n} matches spans a plane", {"n": float(n)})
    S = _best_refined(problem, hypotheses, chi2_gate)
    return _judge(problem, S, rows, len(src), n_tried, chi2_gate, min_inliers, scale_bounds)


def _is_known(xyz: FloatArray, cov: FloatArray) -> BoolArray:
    """Whether points are known to something like the extent of all of them."""
    extent2 = float(np.median(((xyz - np.median(xyz, axis=0)) ** 2).sum(1))) if len(xyz) else 0.0
    return np.asarray(cov.trace(axis1=1, axis2=2) <= UNKNOWN**2 * extent2) | (extent2 == 0.0)


def _best_refined(problem: _Sim3Problem, hypotheses: FloatArray, gate: float) -> FloatArray:
    """Refine hypotheses, best first, and return the one of the least truncated cost.

    One whose inliers are nearly all among those of a refined one would come to the same, and is passed over.
    """
    best: tuple[float, FloatArray] | None = None
    found: list[BoolArray] = []
    for hypothesis in hypotheses:
        near = problem.mahalanobis2(hypothesis[None])[0] < gate
        if any(np.count_nonzero(near & known) >= SAME_BASIN * np.count_nonzero(near) for known in found):
            continue
        S = _refine(problem, hypothesis, gate)
        d2 = problem.mahalanobis2(S[None])[0]
        cost = float(np.minimum(d2, gate).sum())
        found.append(d2 < gate)
        if best is None or cost < best[0]:
            best = cost, S
    assert best is not None
    return best[1]


def _ransac(
    problem: _Sim3Problem, rng: Generator, gate: float, max_hypotheses: int, scale_bounds: tuple[float, float]
) -> tuple[FloatArray, int]:
    """Return the best few hypotheses (M, 4, 4), best first, by truncated cost (MSAC), and how many were tried."""
    n = len(problem.src)
    best, costs = np.zeros((0, 4, 4)), np.zeros(0)
    n_tried, needed = 0, float(max_hypotheses)
    while n_tried < min(needed, max_hypotheses):
        triplets = _draw_triplets(rng, n, min(BATCH, max_hypotheses - n_tried))
        n_tried += len(triplets)
        S, valid = umeyama_batch(problem.src[triplets], problem.dst[triplets])
        s = sim3.scale(S)
        S = S[valid & (s > scale_bounds[0]) & (s < scale_bounds[1])]
        d2 = problem.mahalanobis2(S)
        best, costs = np.concatenate([best, S]), np.concatenate([costs, np.minimum(d2, gate).sum(1)])
        order = np.argsort(costs, kind="stable")[:N_REFINED]
        best, costs = best[order], costs[order]
        if len(d2):
            ratio = float((d2 < gate).mean(1).max())
            failing = math.log(max(1.0 - ratio**3, 1e-12)) if ratio > 0 else 0.0
            if failing < 0:
                needed = min(needed, math.log(1.0 - CONFIDENCE) / failing)
    return best, n_tried


def _draw_triplets(rng: Generator, n: int, count: int) -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
    """Return (count, 3) rows without repetition within a row, uniform, without a loop."""
    i = rng.integers(0, n, count)
    j = rng.integers(0, n - 1, count)
    k = rng.integers(0, n - 2, count)
    j += j >= i
    low, high = np.minimum(i, j), np.maximum(i, j)
    k += k >= low
    k += k >= high
    return np.stack([i, j, k], 1)


def _refine(problem: _Sim3Problem, S: FloatArray, gate: float, n_rounds: int = 4, n_iterations: int = 5) -> FloatArray:
    """Refine a hypothesis by rounds of Huber-weighted Gauss-Newton, inliers judged anew between them."""
    d2 = problem.mahalanobis2(S[None])[0]
    inliers = d2 < gate
    for _ in range(n_rounds):
        for _ in range(n_iterations):
            weight = inliers * huber_weights(d2, CHI2_95[3])
            H, g = problem.normal_equations(S, weight)
            try:
                step = np.linalg.solve(H, g)
            except np.linalg.LinAlgError:
                return S
            # A step beyond this leaves the basin; collinear inliers ask for such steps, and are refused later.
            if not np.isfinite(step).all() or abs(step[6]) > 1.0 or np.linalg.norm(step[:3]) > 1.0:
                return S
            S = S @ sim3.exp(step)
            d2 = problem.mahalanobis2(S[None])[0]
            if float(step @ g) < 1e-8:
                break
        previous, inliers = inliers, d2 < gate
        if np.array_equal(previous, inliers):
            break
    return S


def _judge(
    problem: _Sim3Problem,
    S: FloatArray,
    rows: np.ndarray[tuple[int], np.dtype[np.int64]],
    n_total: int,
    n_tried: int,
    gate: float,
    min_inliers: int,
    scale_bounds: tuple[float, float],
) -> Sim3Estimate | Failure:
    """Pass a refined similarity through the gates and give it its covariance."""
    d2 = problem.mahalanobis2(S[None])[0]
    near = d2 < gate
    n_inliers, s = int(np.count_nonzero(near)), float(sim3.scale(S))
    numbers = {"n": float(len(rows)), "n_inliers": float(n_inliers), "scale": s}
    if n_inliers < max(min_inliers, 3):
        return Failure(FailureReason.TOO_FEW_INLIERS, f"{n_inliers} of {len(rows)}, {min_inliers} needed", numbers)
    if not scale_bounds[0] < s < scale_bounds[1]:
        return Failure(FailureReason.SCALE, f"scale {s:.3g} is out of bounds", numbers)
    plain = umeyama(problem.src[near], problem.dst[near])
    if isinstance(plain, Failure):
        return Failure(FailureReason.DEGENERATE, plain.detail, numbers)
    H, _ = problem.normal_equations(S, near.astype(np.float64))
    covariance = _inverse_hessian(H)
    if covariance is None:
        return Failure(FailureReason.DEGENERATE, f"{n_inliers} inliers do not fix the similarity", numbers)
    rotation_sigma = math.sqrt(float(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    log_scale_sigma = math.sqrt(float(covariance[6, 6]))
    numbers |= {"rotation_sigma_rad": rotation_sigma, "log_scale_sigma": log_scale_sigma}
    if rotation_sigma > MAX_ROTATION_SIGMA_RAD:
        return Failure(FailureReason.DEGENERATE, f"rotation uncertain to {rotation_sigma:.2g} rad", numbers)
    if log_scale_sigma > MAX_LOG_SCALE_SIGMA:
        return Failure(FailureReason.SCALE, f"log-scale uncertain to {log_scale_sigma:.2g}", numbers)
    inliers = np.zeros(n_total, bool)
    inliers[rows[near]] = True
    dof = max(3 * n_inliers - 7, 1)
    return Sim3Estimate(sim3.normalise(S), covariance, inliers, n_tried, float(d2[near].sum()) / dof)


def _inverse_hessian(H: FloatArray) -> FloatArray | None:
    """Return the inflated inverse of a Hessian, None where it is singular."""
    if not (H.diagonal() > 0).all():
        return None
    scale = 1.0 / np.sqrt(H.diagonal())
    eigenvalues, vectors = np.linalg.eigh(H * scale * scale[:, None])
    if not eigenvalues[0] > 1e-12:
        return None
    half = vectors / np.sqrt(eigenvalues) * scale[:, None]
    return np.asarray(COVARIANCE_INFLATION * (half @ half.T), np.float64)
