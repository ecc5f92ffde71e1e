"""Points found again under poses that have moved: by their views alone, the poses held, vectorised."""

from __future__ import annotations

import numpy as np

from dualslam.backend.observability import MIN_DEPTH_MU
from dualslam.core.types import FloatArray, IntArray
from dualslam.map.submap import Submap

STEPS = 3
DAMPING = 1e-6
"""Relative to the trace of a point's information: the depth of one seen along a single line stays where it is."""


def refit_points(submap: Submap, robust_k: float, landmark_ids: IntArray) -> FloatArray:
    """Return (N, 3) landmarks that fit their views better, robustly; one that would not gain stays where it is.

    Parameters
    ----------
    submap : Submap
        Is not changed.
    robust_k : float
        Huber threshold in sigmas.
    landmark_ids : (N,) int64
        Each once.
    """
    obs, place = submap.observations, np.full(len(submap.landmarks), -1)
    place[landmark_ids] = np.arange(len(landmark_ids))
    rows = np.flatnonzero(obs["alive"] & (place[obs["landmark"]] >= 0))
    ids, pose = np.unique(obs["kf"][rows], return_inverse=True)
    T = submap.keyframe_poses(ids)[pose]
    point, best = place[obs["landmark"][rows]], submap.landmarks["xyz_mu"][landmark_ids]
    if not len(rows):
        return best
    uv, sigma = submap.observed_pixels(rows)
    xyz, cost = best, np.full(len(best), np.inf)
    for step in range(STEPS + 1):
        x = np.einsum("rji,rj->ri", T[:, :3, :3], xyz[point] - T[:, :3, 3])
        front = x[:, 2] > MIN_DEPTH_MU
        x = np.where(front[:, None], x, [0.0, 0.0, 1.0])
        K, z = submap.K, x[:, 2]
        pixel = np.stack((K[0, 0] * x[:, 0] + K[0, 1] * x[:, 1], K[1, 1] * x[:, 1]), 1) / z[:, None] + K[:2, 2]
        r = (pixel - uv) / sigma[:, None]
        size = np.linalg.norm(r, axis=1)
        loss = np.where(size <= robust_k, size**2 / 2, robust_k * (size - robust_k / 2))
        now = np.bincount(point, np.where(front, loss, 1e12), len(best))
        better = (now < cost) & np.isfinite(xyz).all(axis=1)
        best, cost = np.where(better[:, None], xyz, best), np.where(better, now, cost)
        if step == STEPS:
            break
        J = np.zeros((len(z), 2, 3))
        J[:, 0, 0], J[:, 0, 1] = K[0, 0] / z, K[0, 1] / z
        J[:, 0, 2] = -(K[0, 0] * x[:, 0] + K[0, 1] * x[:, 1]) / (z * z)
        J[:, 1, 1], J[:, 1, 2] = K[1, 1] / z, -K[1, 1] * x[:, 1] / (z * z)
        J = (J / sigma[:, None, None]) @ T[:, :3, :3].transpose(0, 2, 1)
        weight = np.where(front, np.minimum(1.0, robust_k / np.maximum(size, 1e-12)), 0.0)
        weighted = (J * weight[:, None, None]).transpose(0, 2, 1)
        H = _sums(point, weighted @ J, len(best))
        b = _sums(point, np.einsum("ria,ra->ri", weighted, r), len(best))
        H += (DAMPING * np.trace(H, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(3)
        xyz = xyz - np.linalg.solve(H, b[:, :, None])[:, :, 0]
    return best


def _sums(index: IntArray, values: FloatArray, n: int) -> FloatArray:
    """Return (n, ...): the sum of the rows of each index."""
    flat = values.reshape(len(values), -1)
    sums = np.stack([np.bincount(index, column, n).astype(np.float64) for column in flat.T], 1)
    return sums.reshape(n, *values.shape[1:])
