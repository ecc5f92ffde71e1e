"""The pose of a frame beyond a gap, from wide matches with several frames whose poses are known.

Two ways lead to a first pose. If the known frames have enough parallax, a 3-point solver uses their points. Otherwise
the essential matrix between the gap's two sides gives the direction, and each track that a second known frame sees
gives the length: that helps a map that has just begun. Both poses are refined with the points, the known poses held.
The one with more agreeing tracks stays.

The refinement uses tracks seen in at least two known frames, if enough exist: a track seen in one may lie anywhere on a
line, and a few false ones can bend a pose by a degree unnoticed. See `gap_uncertainty` for the uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualslam.core.bundle import BundleAdjuster, BundleProblem
from dualslam.core.chi_square import CHI2_99
from dualslam.core.errors import SolverError
from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import projection_jacobians
from dualslam.core.geometry.triangulation import triangulate_n_view, triangulate_two_view
from dualslam.core.noise_model import LEAST, MIN_CONSENSUS
from dualslam.core.types import BoolArray, Failure, FailureReason, FloatArray
from dualslam.frontends.gap.auxiliary_map import TrackViews, triangulate
from dualslam.frontends.gap.uncertainty import gap_uncertainty
from dualslam.frontends.tracking.resection import resect
from dualslam.frontends.tracking.two_view_hypotheses import estimate_relative_pose


@dataclass(frozen=True, slots=True, eq=False)
class GapPose:
    """A pose beyond a gap."""

    T_cam_submap: FloatArray  # (4, 4)
    xyz_mu: FloatArray  # (N, 3): of the tracks
    inliers: BoolArray  # (N,): tracks that agree in every view
    chi2: float  # mean squared whitened residual per degree of freedom of the agreeing tracks
    covariance: FloatArray  # (6, 6): of the pose, for a left perturbation (rotation, translation)
    scale_sigma: float  # standard deviation of the log of the scale at which the frame sees its points

    @property
    def numbers(self) -> dict[str, float]:
        """For the event log."""
        return {
            "gap_matches": float(len(self.inliers)),
            "gap_inliers": float(self.inliers.sum()),
            "gap_scale_sigma": self.scale_sigma,
        }


def relocalise_across_gap(
    known: TrackViews,
    uv_px: FloatArray,
    sigma_px: FloatArray,
    K: FloatArray,
    size_px: tuple[int, int],
    adjuster: BundleAdjuster,
    seed: int,
) -> GapPose | Failure:
    """Estimate the pose of a frame.

    - `K` (3, 3), `size_px` (width, height).
    - `known`: each track in the frames of known pose; every track is seen in at least one.
    - `uv_px` (N, 2), `sigma_px` (N,): the tracks in the new frame.
    """
    n = len(uv_px)
    if n < MIN_CONSENSUS:
        return Failure(FailureReason.TOO_FEW_MATCHES, f"{n} wide matches, {MIN_CONSENSUS} needed")
    hypotheses = [
        _from_points(known, uv_px, sigma_px, K, size_px, seed),
        _from_two_views(known, uv_px, sigma_px, K, size_px, seed),
    ]
    best: GapPose | None = None
    for T_cam_submap in hypotheses:
        if T_cam_submap is None:
            continue
        found = _adjust(known, uv_px, sigma_px, K, T_cam_submap, adjuster)
        if found is not None and (best is None or found.inliers.sum() > best.inliers.sum()):
            best = found
    if best is None:
        return Failure(FailureReason.DEGENERATE, f"{n} wide matches fix no pose")
    return best


def _from_points(
    known: TrackViews, uv_px: FloatArray, sigma_px: FloatArray, K: FloatArray, size_px: tuple[int, int], seed: int
) -> FloatArray | None:
    xyz, good = triangulate(known, K)
    if good.sum() < MIN_CONSENSUS:
        return None
    return resect(K, size_px, uv_px[good], xyz[good], float(np.median(sigma_px[good])), seed).T_cam_w


def _from_two_views(
    known: TrackViews, uv_px: FloatArray, sigma_px: FloatArray, K: FloatArray, size_px: tuple[int, int], seed: int
) -> FloatArray | None:
    """Essential matrix with the known frame that shares most tracks, its translation's length from the others."""
    v = int(known.visible.sum(axis=0).argmax())
    shared = known.visible[:, v]
    if shared.sum() < MIN_CONSENSUS:
        return None
    uv_v = known.uv_px[shared, v]
    sigma = np.hypot(known.sigma_px[shared, v], sigma_px[shared])
    T_new_v = estimate_relative_pose(uv_v, uv_px[shared], sigma, K, size_px, seed)
    points = triangulate_two_view(uv_v, uv_px[shared], K, se3.IDENTITY, se3.inverse(T_new_v))
    usable = (points.depth_a > 0) & (points.depth_b > 0) & np.isfinite(points.xyz).all(axis=1)
    T_others_v = known.T_cam_submap @ se3.inverse(known.T_cam_submap[v])
    seen = known.visible[shared] & usable[:, None]
    seen[:, v] = False
    length = _length(points.xyz, known.uv_px[shared], seen, T_others_v, K)
    if length is None:
        return None
    return np.asarray(se3.scaled(T_new_v, length) @ known.T_cam_submap[v], np.float64)


def _length(xyz: FloatArray, uv_px: FloatArray, seen: BoolArray, T_others_v: FloatArray, K: FloatArray) -> float | None:
    """Return the factor by which points (N, 3) must grow for other frames to see them where they do.

    A point p, grown to s p, is at ``s R p + t`` in another frame, which sees it at x: ``s (a - x a_z) = x t_z - t``
    with ``a = R p`` (the first two rows). Each track says its own s; their median, weighted by how far s moves the
    pixel, stands.
    """
    row, v = np.nonzero(seen)
    x = (uv_px[row, v] - K[:2, 2]) / (K[0, 0], K[1, 1])
    a = np.einsum("nij,nj->ni", T_others_v[v, :3, :3], xyz[row])
    t = T_others_v[v, :3, 3]
    e, d = a[:, :2] - x * a[:, 2:], x * t[:, 2:] - t[:, :2]
    e2 = np.einsum("ij,ij->i", e, e)
    s = np.einsum("ij,ij->i", e, d) / np.maximum(e2, LEAST)
    # Pixels move by about |e| / a_z for a relative change of s; where that is nothing, s is anything.
    weight = np.where(a[:, 2] > 0, np.sqrt(e2) / np.where(a[:, 2] > 0, a[:, 2], 1.0), 0.0)
    if len(s) < MIN_CONSENSUS or not weight.sum() > 0:
        return None
    order = np.argsort(s, kind="stable")
    half = np.searchsorted(np.cumsum(weight[order]), weight.sum() / 2)
    length = float(s[order[min(int(half), len(s) - 1)]])
    return length if length > 0 else None


def _adjust(
    known: TrackViews,
    uv_px: FloatArray,
    sigma_px: FloatArray,
    K: FloatArray,
    T_cam_submap: FloatArray,
    adjuster: BundleAdjuster,
) -> GapPose | None:
    """Refine pose and points with the known poses held; twice, so that the second time is without outliers."""
    uv = np.concatenate([known.uv_px, uv_px[:, None]], axis=1)
    sigma = np.concatenate([known.sigma_px, sigma_px[:, None]], axis=1)
    visible = np.concatenate([known.visible, np.ones((len(uv_px), 1), bool)], axis=1)
    T = np.concatenate([known.T_cam_submap, T_cam_submap[None]])
    fixed = np.arange(len(T)) < len(T) - 1
    inliers, points = np.ones(len(uv_px), bool), triangulate_n_view(uv, K, T, visible)
    # What is behind a camera under the first pose takes no part in its refinement; it is judged again after it.
    inliers &= ((points.depth > 0) | ~visible).all(axis=1) & np.isfinite(points.xyz).all(axis=1)
    xyz, chi2 = points.xyz, np.where(visible, points.error2 / sigma**2, 0.0)
    for _ in range(2):
        used = _heard(inliers & (chi2 < 16 * CHI2_99[2]).all(axis=1), known.visible)
        if used.sum() < MIN_CONSENSUS:
            return None
        row, view = np.nonzero(visible & used[:, None])
        point = (np.cumsum(used) - 1)[row]
        problem = BundleProblem(K, se3.inverse(T), fixed, xyz[used], view, point, uv[row, view], sigma[row, view])
        try:
            result = adjuster(problem)
        except SolverError:
            return None
        T = se3.inverse(result.T_submap_kf)
        points = triangulate_n_view(uv, K, T, visible)
        xyz = points.xyz.copy()
        xyz[used] = np.where(result.adjusted[:, None], result.xyz_mu, xyz[used])
        chi2 = np.where(visible, points.error2 / sigma**2, 0.0)
        in_front = ((points.depth > 0) | ~visible).all(axis=1) & np.isfinite(xyz).all(axis=1)
        inliers = in_front & (np.nan_to_num(chi2, nan=np.inf) < CHI2_99[2]).all(axis=1)
    if inliers.sum() < MIN_CONSENSUS:
        return None
    mean = float(chi2[inliers].sum() / (2 * visible[inliers].sum() - 3 * inliers.sum()).clip(1))
    used = _heard(inliers, known.visible)
    information = np.zeros((int(used.sum()), 3, 3))
    for v in range(len(T) - 1):
        _, J_point = projection_jacobians(K, T[v], xyz[used])
        weight = (visible[used, v] / sigma[used, v] ** 2)[:, None, None]
        information += J_point.swapaxes(1, 2) @ (weight * J_point)
    covariance, scale_sigma = gap_uncertainty(K, T[-1], xyz[used], sigma[used, -1], information)
    return GapPose(T[-1], xyz, inliers, mean, covariance, scale_sigma)


def _heard(agree: BoolArray, visible: BoolArray) -> BoolArray:
    """Return which of the agreeing tracks fix the pose: those that two known frames see, or all if these are few."""
    twice = agree & (visible.sum(axis=1) >= 2)
    return twice if twice.sum() >= MIN_CONSENSUS else agree
