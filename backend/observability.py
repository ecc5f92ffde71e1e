"""Which observations a factor graph can bear: residuals, depth and the certainty of points, vectorised.

A landmark with one view, or with views along one line, makes the whole linear system indeterminate. A point behind a
camera has no derivative at all. So each variable is checked before it enters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from dualslam.core.geometry import se3
from dualslam.core.noise_model import MIN_DEPTH_MU
from dualslam.core.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """How R observations fit."""

    chi2: FloatArray  # (R,): squared whitened residual; infinite where the point is not in front of the camera
    depth_mu: FloatArray  # (R,): along the optical axis
    xyz_cam: FloatArray  # (R, 3)


def compute_residuals(
    K: FloatArray, T_submap_kf: FloatArray, pose: IntArray, xyz_mu: FloatArray, uv_px: FloatArray, sigma_px: FloatArray
) -> Residuals:
    """Reproject.

    - `K` (3, 3), `T_submap_kf` (P, 4, 4), `xyz_mu` (R, 3), `uv_px` (R, 2), `sigma_px` (R,).
    - `pose` (R,): row of `T_submap_kf` of each observation.
    """
    xyz_cam, front, uv = reproject(K, T_submap_kf, pose, xyz_mu)
    u, v = (uv - uv_px).T
    chi2 = np.where(front, (u * u + v * v) / (sigma_px * sigma_px), np.inf)
    chi2[~np.isfinite(chi2)] = np.inf
    return Residuals(chi2, xyz_cam[:, 2], xyz_cam)


def reproject(
    K: FloatArray, T_submap_kf: FloatArray, pose: IntArray, xyz_mu: FloatArray
) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Project R points, each by a pose of its own; arguments as in `compute_residuals`.

    Returns the points in the cameras (R, 3), which of them are in front (R,), and their pixels (R, 2): that of the
    optical axis for those behind.
    """
    # Coordinate by coordinate, each an array of its own: half the time of (R, 3, 3) by (R, 3).
    of = T_submap_kf[:, :3].transpose(2, 1, 0).reshape(12, -1).take(pose, axis=1).reshape(4, 3, -1)  # column, row
    dx, dy, dz = xyz_mu.T - of[3]
    cam = of[:3, 0] * dx
    cam += of[:3, 1] * dy
    cam += of[:3, 2] * dz
    front = cam[2] > MIN_DEPTH_MU
    x, y = np.where(front, cam[:2], 0.0) / np.where(front, cam[2], 1.0)
    uv_px = np.column_stack((K[0, 0] * x + K[0, 1] * y + K[0, 2], K[1, 1] * y + K[1, 2]))
    xyz_cam = np.ascontiguousarray(cam.T)
    return xyz_cam, front, uv_px


def projection_jacobian(
    K: FloatArray, R_submap_kf: FloatArray, xyz_cam: FloatArray, sigma_px: FloatArray
) -> FloatArray:
    """Return (2, 3, R): the whitened derivative of pixels by points in the submap, coordinate by coordinate.

    - `K` (3, 3), `R_submap_kf` (R, 3, 3), `sigma_px` (R,).
    - `xyz_cam` (R, 3): in front of the camera.
    """
    x, y, z = xyz_cam.T
    w = 1 / (z * sigma_px)
    R = np.ascontiguousarray(R_submap_kf.transpose(2, 1, 0))  # column, row
    J = np.empty((2, 3, len(z)))
    J[0] = (K[0, 0] * w) * R[0] + (K[0, 1] * w) * R[1] - ((K[0, 0] * x + K[0, 1] * y) * w / z) * R[2]
    J[1] = (K[1, 1] * w) * R[1] - (K[1, 1] * y * w / z) * R[2]
    return J


def sum_products(weighted: FloatArray, J: FloatArray, point: IntArray, n_points: int) -> FloatArray:
    """Return (n_points, 3, 3): the sum of J'WJ over the views of each point, for WJ and J (2, 3, R)."""
    H = np.empty((n_points, 3, 3))
    for i, j in ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2)):
        H[:, i, j] = H[:, j, i] = np.bincount(point, weighted[0, i] * J[0, j] + weighted[1, i] * J[1, j], n_points)
    return H


def compute_depth_sigmas(
    K: FloatArray,
    T_submap_kf: FloatArray,
    pose: IntArray,
    xyz_cam: FloatArray,
    sigma_px: FloatArray,
    point: IntArray,
    n_points: int,
) -> FloatArray:
    """Return how well each point is fixed by its views alone, the poses taken as known.

    - `K` (3, 3), `T_submap_kf` (P, 4, 4), `pose` (R,), `sigma_px` (R,): as in `compute_residuals`.
    - `xyz_cam` (R, 3): the point of each observation, in front of its camera.
    - `point` (R,): which of the `n_points` points each observation sees.

    Returns (n_points,) float64: largest standard deviation of the point relative to its least depth; infinite with
    fewer than two views.
    """
    J = projection_jacobian(K, se3.rotation(T_submap_kf.take(pose, axis=0)), xyz_cam, sigma_px)
    information = sum_products(J, J, point, n_points)
    depth = np.full(n_points, np.inf)
    np.minimum.at(depth, point, xyz_cam[:, 2])
    smallest = np.linalg.eigvalsh(information)[:, 0]
    views = np.bincount(point, minlength=n_points)
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = 1 / (np.sqrt(np.maximum(smallest, 0)) * depth)
    return np.where((views >= 2) & (smallest > 0), sigma, np.inf)


def find_components(kf: IntArray, landmark: IntArray) -> tuple[IntArray, IntArray]:
    """Return the keyframes that occur, ascending, and for each the number of the connected piece it belongs to.

    Two keyframes are connected where they share a landmark. Pieces count from 0, by their first keyframe.
    """
    ids, k = numbered(kf)
    landmarks, j = numbered(landmark)
    nodes = len(ids) + len(landmarks)
    seen = coo_matrix((np.ones(len(k), bool), (k, len(ids) + j)), shape=(nodes, nodes))
    return ids, connected_components(seen, directed=False)[1][: len(ids)].astype(np.int64)


def numbered(values: IntArray) -> tuple[IntArray, IntArray]:
    """Return which ids occur, ascending, and the place of each value among them: `numpy.unique`, without sorting.

    Ids are small whole numbers, such as those of keyframes and landmarks.
    """
    seen = take_mask(values, int(values.max(initial=-1)) + 1)
    return np.flatnonzero(seen), (np.cumsum(seen) - 1)[values]


def take_mask(ids: IntArray, size: int) -> BoolArray:
    """Return a mask of `size` that is true at `ids`."""
    mask = np.zeros(size, bool)
    mask[ids] = True
    return mask
