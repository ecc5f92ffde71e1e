"""Batch bundle adjustment of a submap, or a part of it: initialisation, calibration, the last refinement."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from dualslam.backend.observability import compute_depth_sigmas, compute_residuals
from dualslam.backend.point_refinement import huber
from dualslam.backend.schur import geman_mcclure, optimise
from dualslam.core.bundle import BundleProblem, BundleResult, FrameRows
from dualslam.core.chi_square import CHI2_99
from dualslam.core.noise_model import TINY
from dualslam.core.types import FloatArray, IntArray
from dualslam.map.submap import Submap

MAX_DEPTH_SIGMA = 1.0
"""A point whose distance is known no better than this (relative, one sigma) is not adjusted."""
ITERATIONS = 5
"""Of `adjust_and_prune`."""


@dataclass(frozen=True, slots=True, eq=False)
class SubmapBundle:
    """A `BundleResult` in a submap's ids: ``submap.apply_estimate(*bundle.estimate)`` takes it over."""

    keyframe_ids: IntArray  # (F,): the free ones first
    landmark_ids: IntArray  # (P,)
    rows: IntArray  # (R,): rows of the submap's observation table, as in ``result.chi2``
    result: BundleResult
    T_submap_frame: FloatArray  # (G, 4, 4): poses of the frames that took part

    @property
    def estimate(self) -> tuple[IntArray, FloatArray, IntArray, FloatArray]:
        """Arguments of `Submap.apply_estimate`."""
        result = self.result
        return (
            self.keyframe_ids,
            result.T_submap_kf,
            self.landmark_ids[result.adjusted],
            result.xyz_mu[result.adjusted],
        )


def bundle_adjust_arrays(
    problem: BundleProblem,
    robust_k: float = 1.345,
    max_iterations: int = 10,
    tolerance: float = 1e-4,
    forgets: bool = False,
) -> BundleResult:
    """Refine poses and points.

    Parameters
    ----------
    problem : BundleProblem
    robust_k : float
        Huber threshold in sigmas.
    max_iterations : int
    tolerance : float
        Relative decrease of the cost below which to stop.
    forgets : bool
        Whether the loss is Geman and McClure's with the shape `robust_k`, under which outliers no longer count.

    Raises
    ------
    SolverError
        If the system has no optimum.
    """
    p = problem
    before = compute_residuals(p.K, p.T_submap_kf, p.kf, p.xyz_mu[p.point], p.uv_px, p.sigma_px)
    front = np.flatnonzero(np.isfinite(before.chi2))
    sigmas = compute_depth_sigmas(
        p.K, p.T_submap_kf, p.kf[front], before.xyz_cam[front], p.sigma_px[front], p.point[front], len(p.xyz_mu)
    )
    adjusted = sigmas < MAX_DEPTH_SIGMA
    row = front[adjusted[p.point[front]]]
    points = np.flatnonzero(adjusted)
    number = np.cumsum(adjusted) - 1
    T, xyz, cost = p.T_submap_kf.copy(), p.xyz_mu.copy(), (0.0, 0.0)
    if len(row):
        used = BundleProblem(
            p.K, T, p.fixed, xyz[points], p.kf[row], number[p.point[row]], p.uv_px[row], p.sigma_px[row]
        )
        loss = partial(geman_mcclure, shape=robust_k) if forgets else partial(huber, k=robust_k)
        optimum = optimise(used, loss, max_iterations, tolerance)
        T, xyz[points] = optimum.state.T_submap_kf, optimum.state.xyz_mu
        cost = optimum.cost_before, optimum.cost_after
    after = compute_residuals(p.K, T, p.kf, xyz[p.point], p.uv_px, p.sigma_px)
    return BundleResult(T, xyz, adjusted, after.chi2, *cost)


def bundle_adjust(
    submap: Submap,
    free_keyframes: IntArray | list[int],
    fixed_keyframes: IntArray | list[int] | None = None,
    robust_k: float = 1.345,
    max_iterations: int = 10,
    forgets: bool = False,
    frames: FrameRows | None = None,
    landmarks: IntArray | None = None,
) -> SubmapBundle:
    """Refine some keyframes of a submap and the landmarks that they see; the submap itself is not changed.

    Parameters
    ----------
    submap : Submap
    free_keyframes : keyframe ids
        To be refined.
    fixed_keyframes : keyframe ids, optional
        Seen from these the landmarks are fixed in place; default: all other keyframes that see any of them.
    robust_k, max_iterations, forgets
        See `bundle_adjust_arrays`.
    frames : FrameRows, optional
        Frames that count, too. Their poses are free.
    landmarks : landmark ids, optional
        Those of them that take part, ascending; default: all.

    Raises
    ------
    SolverError
        If the solver fails.
    """
    free = np.asarray(free_keyframes, np.int64)
    seen = submap.landmarks_of_keyframes(free)
    landmarks = seen if landmarks is None else np.intersect1d(seen, landmarks)
    if fixed_keyframes is None:
        fixed_keyframes = np.setdiff1d(submap.covisible(landmarks)[0], free)
    keyframes = np.concatenate([free, np.asarray(fixed_keyframes, np.int64)])
    rows = submap.rows_of_landmarks(landmarks)
    kf = submap.observations["kf"][rows]
    inside = np.isin(kf, keyframes)
    rows, kf = rows[inside], kf[inside]
    order = np.argsort(keyframes)
    pose, point = order[np.searchsorted(keyframes[order], kf)], submap.observations["landmark"][rows]
    uv, sigma = submap.observed_pixels(rows)
    T, fixed = submap.keyframe_poses(keyframes), np.arange(len(keyframes)) >= len(free)
    if frames is not None:
        known = np.isin(frames.landmark_ids, landmarks)
        T = np.concatenate([T, frames.T_submap_cam])
        fixed = np.concatenate([fixed, np.zeros(len(frames.T_submap_cam), bool)])
        pose = np.concatenate([pose, len(keyframes) + frames.frame[known]])
        point = np.concatenate([point, frames.landmark_ids[known]])
        uv = np.concatenate([uv, frames.uv_px[known]])
        sigma = np.concatenate([sigma, frames.sigma_px[known]])
    xyz_mu, point = submap.landmarks["xyz_mu"][landmarks], np.searchsorted(landmarks, point)
    problem = BundleProblem(submap.K, T, fixed, xyz_mu, pose, point, uv, sigma)
    result = bundle_adjust_arrays(problem, robust_k, max_iterations, forgets=forgets)
    n, n_rows = len(keyframes), len(rows)
    T_submap_frame = result.T_submap_kf[n:]
    result = replace(result, T_submap_kf=result.T_submap_kf[:n], chi2=result.chi2[:n_rows])
    return SubmapBundle(keyframes, landmarks, rows, result, T_submap_frame)


def adjust_and_prune(
    submap: Submap,
    keyframe_ids: Collection[int],
    robust_k: float,
    min_parallax_rad: float,
    noise2: float = 1.0,
) -> None:
    """Adjust some keyframes and the landmarks that they see, in place; then remove what does not fit.

    - `keyframe_ids`: where they are all of the submap's, its first two stay.
    - `min_parallax_rad`: landmarks that are seen under a smaller angle are removed. A pose that stands on them has no
      scale, and neither have the landmarks that are triangulated from there.
    - `noise2`: variance of the whitened residuals.

    Raises `SolverError` if the solver fails.
    """
    free, held = list(keyframe_ids), None
    if len(free) == len(submap.keyframes):
        held = [k for k in submap.gauge if k in submap.keyframes] or free[:1]
        free = [k for k in free if k not in held]
    bundle = bundle_adjust(submap, free, held, robust_k, ITERATIONS)
    submap.apply_estimate(*bundle.estimate)
    submap.remove_outliers(bundle.rows[~(bundle.result.chi2 < noise2 * CHI2_99[2])])
    seen = submap.landmarks_of_keyframes(list(keyframe_ids))
    submap.remove_landmarks(seen[parallax_rad(submap, seen) < min_parallax_rad])


def parallax_rad(submap: Submap, landmark_ids: IntArray) -> FloatArray:
    """Return about the widest angle (N,) between the rays by which each landmark is seen.

    From the ray farthest from the first one to the ray farthest from that: exact where a camera moves along a line.

    `landmark_ids` (N,): ascending.
    """
    rows = submap.rows_of_landmarks(landmark_ids)
    ids, pose = np.unique(submap.observations["kf"][rows], return_inverse=True)
    landmark = submap.observations["landmark"][rows]
    rays = submap.landmarks["xyz_mu"][landmark] - submap.keyframe_poses(ids)[pose, :3, 3]
    rays /= np.maximum(np.linalg.norm(rays, axis=1), TINY)[:, None]
    order = np.argsort(landmark, kind="stable")
    rays, point = rays[order], np.searchsorted(landmark_ids, landmark[order])
    begins = np.flatnonzero(np.diff(point, prepend=-1))
    reference, widest = rays[begins], np.ones(len(landmark_ids))
    at = np.cumsum(np.diff(point, prepend=-1) > 0) - 1
    for _ in range(2):
        cosine = np.einsum("ij,ij->i", rays, reference[at])
        farthest = np.lexsort((cosine, point))[begins]
        reference = rays[farthest]
        widest[point[begins]] = cosine[farthest]
    return np.arccos(np.clip(widest, -1.0, 1.0))
