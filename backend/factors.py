"""Factors, inserted in bulk where there are many."""

from __future__ import annotations

import gtsam
import numpy as np

from dualslam.backend.convert import pose_key, to_pose3
from dualslam.backend.noise import GAUGE_RANGE_RATIO, GAUGE_SIGMA, PixelNoise, pose_sigmas
from dualslam.core.types import FloatArray, IntArray
from dualslam.map.anchors import RelativePose


def insert_projections(
    graph: gtsam.NonlinearFactorGraph,
    kf: IntArray,
    landmark: IntArray,
    uv_px: FloatArray,
    sigma_px: FloatArray,
    K: gtsam.Cal3_S2,
    noise: PixelNoise,
) -> IntArray:
    """Append one projection factor per observation, in as few calls as keyframes and sigmas allow.

    - `kf`, `landmark` (R,), `uv_px` (R, 2), `sigma_px` (R,).
    - `graph`: is appended to.

    Returns (R,) int64: order of insertion: the i-th new factor is that of observation ``order[i]``.
    """
    order = np.lexsort((landmark, sigma_px, kf))
    if len(order) == 0:
        return order
    k, s = kf[order], sigma_px[order]
    cuts = np.flatnonzero((np.diff(k) != 0) | (np.diff(s) != 0)) + 1
    starts = np.concatenate(([0], cuts))
    ends = np.append(cuts, len(order)).tolist()
    keys, sigmas = k[starts].tolist(), s[starts].tolist()
    J = landmark[order].astype(float)
    Z = np.ascontiguousarray(uv_px[order].T)
    insert = gtsam.utilities.insertProjectionFactors
    for a, b, key, sigma in zip(starts.tolist(), ends, keys, sigmas, strict=True):
        insert(graph, pose_key(key), J[a:b], Z[:, a:b], noise(sigma), K)
    return order


def pose_prior(
    keyframe_id: int, T_submap_kf: FloatArray, rotation_rad: float = GAUGE_SIGMA, translation_mu: float = GAUGE_SIGMA
) -> gtsam.PriorFactorPose3:
    """Return a prior on a keyframe's pose; by default tight (a gauge)."""
    return gtsam.PriorFactorPose3(
        pose_key(keyframe_id), to_pose3(T_submap_kf), pose_sigmas(rotation_rad, translation_mu)
    )


def relative_pose(keyframe_id: int, known: RelativePose) -> gtsam.BetweenFactorPose3:
    """Return the factor of what is known of a keyframe's pose relative to another one."""
    noise = gtsam.noiseModel.Gaussian.Covariance(known.covariance)
    return gtsam.BetweenFactorPose3(pose_key(known.keyframe_id), pose_key(keyframe_id), to_pose3(known.T_ref_kf), noise)


def baseline_factor(first: int, second: int, length_mu: float) -> gtsam.RangeFactorPose3:
    """Return the factor that fixes a submap's scale: the distance between the centres of two keyframes."""
    noise = gtsam.noiseModel.Isotropic.Sigma(1, GAUGE_RANGE_RATIO * length_mu)
    return gtsam.RangeFactorPose3(pose_key(first), pose_key(second), length_mu, noise)
