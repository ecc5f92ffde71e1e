"""Points from two or more views of known pose, whole batches at a time, and how well they are known.

Everything here minimises the reprojection error in pixels. Cheirality (is the point in front?) and parallax are left to
the caller as numbers and plain masks: what counts as enough is a matter of the stage that asks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualslam.core.geometry import se3, symmetric3
from dualslam.core.types import BoolArray, FloatArray, IntArray

MIN_INVERSE_DEPTH = 1e-12
"""In units of the baseline: a point with less is at infinity for all that float64 can say."""
MIN_RELATIVE_DETERMINANT = 1e-13
"""Of a point's 3x3 information, relative to its trace cubed over 27: below, a direction is not observed at all. (Two
views with 0.001 deg of parallax have 1e-10.)"""

STEPS_TWO_VIEWS, STEPS_MANY_VIEWS = 2, 3
"""Gauss-Newton steps; two reach the minimum of two views to about 1e-3 px even at several px of noise."""
MIN_COLUMNS = 4
"""Points with up to so many views are taken together; with twice as many the next ones."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoViewPoints:
    """Triangulated points of N matched pixels."""

    xyz: FloatArray
    """(N, 3): in the frame w of the given poses. Behind both cameras where the rays diverge."""
    # z in either camera; negative behind it.
    depth_a: FloatArray  # (N,)
    depth_b: FloatArray  # (N,)
    cos_parallax: FloatArray  # (N,): cosine of the angle between the two observed rays
    # Squared reprojection errors, px^2.
    error2_a: FloatArray  # (N,)
    error2_b: FloatArray  # (N,)


@dataclass(frozen=True, slots=True, eq=False)
class NViewPoints:
    """Triangulated points of N tracks."""

    xyz: FloatArray
    """(N, 3): in w; NaN where fewer than two views see the point. Parallel rays meet very far away."""
    depth: FloatArray  # (N, V): z in each camera, NaN where not visible
    error2: FloatArray  # (N, V): squared reprojection errors, px^2, NaN where not visible
    min_cos_parallax: FloatArray  # (N,): smallest cosine between any two of the rays: the widest parallax


def in_front(*depths: FloatArray) -> BoolArray:
    """Return the mask of points in front of every camera (cheirality); NaN counts as not visible there."""
    mask = np.ones(depths[0].shape[0], bool)
    for depth in depths:
        seen = ~(depth <= 0.0)
        mask &= seen if depth.ndim == 1 else seen.all(1)
    return mask


def triangulate_two_view(
    uv_a: FloatArray, uv_b: FloatArray, K: FloatArray, T_w_a: FloatArray, T_w_b: FloatArray
) -> TwoViewPoints:
    """Triangulate matched pixels of two views with minimal reprojection error.

    A point is (alpha, beta, 1) / rho in camera a: near-infinite points are as regular as others, and view a constrains
    alpha and beta only. With alpha and beta as observed, view b is linear in rho, which gives the start. Gauss-Newton
    on all three then spreads the error over both views. No loop over points, no decomposition.

    - `uv_a`, `uv_b` (N, 2): rectified pixels.
    - `K` (3, 3): intrinsics of both, zero skew.
    - `T_w_a`, `T_w_b` (4, 4): camera poses in w; their centres must differ.
    """
    T_b_a = se3.inverse(T_w_b) @ T_w_a
    R, t = T_b_a[:3, :3], T_b_a[:3, 3]
    fx, fy = float(K[0, 0]), float(K[1, 1])
    focal, centre = np.array([[fx], [fy]]), K[:2, 2:]
    xa, ya = (uv_a.T - centre) / focal
    xb, yb = (uv_b.T - centre) / focal
    # Ray of a, turned into b; r + rho t is the point in b, times rho.
    rx, ry, rz = R @ np.stack([xa, ya, np.ones_like(xa)])
    ex, ey, bx, by = rx - xb * rz, ry - yb * rz, t[0] - xb * t[2], t[1] - yb * t[2]
    rho = -(ex * bx + ey * by) / np.maximum(bx * bx + by * by, 1e-300)
    ray_norms2 = (1.0 + xa * xa + ya * ya) * (1.0 + xb * xb + yb * yb)
    cos_parallax = (xb * rx + yb * ry + rz) / np.sqrt(ray_norms2)
    point = np.stack([xa, ya, rho])
    for _ in range(STEPS_TWO_VIEWS):
        point += _inverse_depth_step(point, np.stack([xa, ya]), np.stack([xb, yb]), R, t, fx, fy)
    smallest = MIN_INVERSE_DEPTH / max(float(np.sqrt(t @ t)), 1e-300)
    rho = np.where(np.abs(point[2]) < smallest, smallest, point[2])
    depth_a = 1.0 / rho
    p_a = np.stack([point[0] * depth_a, point[1] * depth_a, depth_a])
    p_b = R @ p_a + t[:, None]
    depth_b = p_b[2]
    safe = np.where(depth_b == 0.0, np.nan, depth_b)
    error2_a = (fx * (point[0] - xa)) ** 2 + (fy * (point[1] - ya)) ** 2
    error2_b = (fx * (p_b[0] / safe - xb)) ** 2 + (fy * (p_b[1] / safe - yb)) ** 2
    xyz = p_a.T @ T_w_a[:3, :3].T + T_w_a[:3, 3]
    return TwoViewPoints(xyz, depth_a, depth_b, cos_parallax, error2_a, error2_b)


def _inverse_depth_step(
    point: FloatArray, obs_a: FloatArray, obs_b: FloatArray, R: FloatArray, t: FloatArray, fx: float, fy: float
) -> FloatArray:
    """Return the Gauss-Newton step (3, N) of (alpha, beta, rho) for the summed squared pixel errors of both views."""
    alpha, beta, rho = point
    q = R[:, :1] * alpha + R[:, 1:2] * beta + R[:, 2:] + t[:, None] * rho
    iz = 1.0 / np.where(np.abs(q[2]) < 1e-9, 1e-9, q[2])
    u, v = q[0] * iz, q[1] * iz
    # Columns of d(u, v) / d(alpha, beta, rho), in pixels: (column[0:2] - (u, v) column[2]) / z.
    fu, fv = fx * iz, fy * iz
    columns = np.array([R[:, 0], R[:, 1], t])
    Ju = (columns[:, :1] - columns[:, 2:] * u) * fu
    Jv = (columns[:, 1:2] - columns[:, 2:] * v) * fv
    ra, rb = alpha - obs_a[0], beta - obs_a[1]
    ru, rv = fx * (u - obs_b[0]), fy * (v - obs_b[1])
    H = Ju[symmetric3.ROWS] * Ju[symmetric3.COLUMNS] + Jv[symmetric3.ROWS] * Jv[symmetric3.COLUMNS]
    H[0] += fx * fx
    H[3] += fy * fy
    g = Ju * ru + Jv * rv
    g[0] += fx * fx * ra
    g[1] += fy * fy * rb
    adj, det = symmetric3.adjugate(H)
    # Where nothing observes rho (no baseline, or a point at the epipole) leave the point alone.
    inverse = np.where(det > 1e-14 * H[0] * H[3] * np.maximum(H[5], 1e-300), -1.0 / np.maximum(det, 1e-300), 0.0)
    return symmetric3.multiply(adj, g) * inverse


def triangulate_n_view(
    uv: FloatArray, K: FloatArray, T_cam_w: FloatArray, visible: BoolArray | None = None
) -> NViewPoints:
    """Triangulate N points from V views: linear, then Gauss-Newton on the reprojection error.

    As in `triangulate_two_view` a point is (alpha, beta, 1) / rho, here in the first camera that sees it.

    - `T_cam_w` (V, 4, 4).
    - `uv` (N, V, 2): rectified pixels; ignored where not visible.
    - `K` (3, 3): intrinsics, zero skew.
    - `visible` (N, V) bool: which views see which point; all by default.
    """
    n, n_views = uv.shape[:2]
    seen = np.ones((n, n_views), bool) if visible is None else np.asarray(visible, bool)
    found = NViewPoints(np.empty((n, 3)), np.empty((n, n_views)), np.empty((n, n_views)), np.empty(n))
    # Of many views most points have few: those that have about as many are taken together.
    width = 2 ** np.ceil(np.log2(seen.sum(1).clip(MIN_COLUMNS))).astype(np.int64)
    for n_columns in np.unique(width).tolist():
        rows = np.flatnonzero(width == n_columns)
        part = _triangulate_alike(uv[rows], K, T_cam_w, seen[rows], n_columns)
        found.xyz[rows], found.min_cos_parallax[rows] = part.xyz, part.min_cos_parallax
        found.depth[rows], found.error2[rows] = part.depth, part.error2
    return found


def _triangulate_alike(
    uv: FloatArray, K: FloatArray, T_cam_w: FloatArray, seen: BoolArray, n_columns: int
) -> NViewPoints:
    """Triangulate points of which none has more than `n_columns` views."""
    n, n_views = seen.shape
    # Each point's own views come first.
    column = np.argsort(~seen, axis=1, kind="stable")[:, :n_columns]
    seen, uv = np.take_along_axis(seen, column, 1), np.take_along_axis(uv, column[..., None], 1)
    w = np.repeat(seen[..., None], 2, -1).astype(np.float64)
    focal, centre = np.array([K[0, 0], K[1, 1]]), K[:2, 2]
    x = np.where(seen[..., None], (uv - centre) / focal, 0.0)
    T_w_cam = se3.inverse(T_cam_w)
    T_w_ref = T_w_cam[column[:, 0]]
    T = T_cam_w[column] @ T_w_ref[:, None]
    unit = max(float(np.abs(T[..., :3, 3]).max(initial=0.0)), 1e-300)
    M = np.concatenate([T[..., :3, :2], T[..., :3, 3:] / unit], -1)
    c = T[..., :3, 2]
    # In each view q = M (alpha, beta, rho) + c is the point up to scale; x q_z = q_x is linear.
    point = _solve_points(M[..., :2, :] - x[..., None] * M[..., 2:, :], x * c[..., 2:] - c[..., :2], w)
    for _ in range(STEPS_MANY_VIEWS):
        q, J = _project_views(point, M, c)
        w_front = w * (q[..., 2:] > 0)
        step = _solve_points(J * focal[:, None], (x - q[..., :2]) * focal, w_front)
        point = point + np.where(np.isfinite(step), step, 0.0)
    q, _ = _project_views(point, M, c)
    rho = np.where(np.abs(point[:, 2]) < MIN_INVERSE_DEPTH, MIN_INVERSE_DEPTH, point[:, 2]) / unit
    p_ref = np.stack([point[:, 0], point[:, 1], np.ones(n)], -1) / rho[:, None]
    nowhere = np.where(seen, 0.0, np.nan)
    depth, error2 = np.full((2, n, n_views), np.nan)
    np.put_along_axis(depth, column, q[..., 2] / rho[:, None] + nowhere, 1)
    np.put_along_axis(error2, column, (((x - q[..., :2]) * focal) ** 2).sum(-1) + nowhere, 1)
    cos = _widest_parallax(x, seen, T_w_cam[column][..., :3, :3])
    return NViewPoints(se3.act_each(T_w_ref, p_ref), depth, error2, cos)


def _widest_parallax(x: FloatArray, seen: BoolArray, R_w_cam: FloatArray) -> FloatArray:
    """Return the smallest cosine (N,) between any two rays of each point.

    `x` (N, V, 2) is normalised, `R_w_cam` (N, V, 3, 3).
    """
    rays = (R_w_cam @ np.concatenate([x, np.ones_like(x[..., :1])], -1)[..., None])[..., 0]
    rays /= np.sqrt((rays * rays).sum(-1, keepdims=True))
    both = seen[:, :, None] & seen[:, None, :] & ~np.eye(x.shape[1], dtype=bool)
    return np.asarray(np.where(both, rays @ rays.swapaxes(1, 2), 1.0).min((1, 2)), np.float64)


def _project_views(point: FloatArray, M: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (x, y, q_z) in each view (N, V, 3), x and y normalised, and d(x, y)/d(point) (N, V, 2, 3)."""
    q = (M @ point[:, None, :, None])[..., 0] + c
    z = np.where(q[..., 2] == 0.0, np.nan, q[..., 2])
    q[..., :2] /= z[..., None]
    J = (M[..., :2, :] - q[..., :2, None] * M[..., 2:, :]) / z[..., None, None]
    return q, J


def _solve_points(A: FloatArray, b: FloatArray, weight: FloatArray) -> FloatArray:
    """Return (N, 3) weighted least squares of rows A (N, V, 2, 3), b and weight (N, V, 2); NaN where singular."""
    rows = (A * weight[..., None]).reshape(len(A), -1, 3)
    H = rows.swapaxes(1, 2) @ A.reshape(len(A), -1, 3)
    g = (rows.swapaxes(1, 2) @ b.reshape(len(A), -1, 1))[..., 0]
    return symmetric3.multiply(_inverse_or_nan(symmetric3.planes(H)), g.T).T


def _inverse_or_nan(H: FloatArray) -> FloatArray:
    """Return the six planes of the inverses, NaN where singular in the sense of `MIN_RELATIVE_DETERMINANT`."""
    adj, det = symmetric3.adjugate(H)
    regular = det > MIN_RELATIVE_DETERMINANT * ((H[0] + H[3] + H[5]) / 3.0) ** 3
    return np.asarray(adj / np.where(regular & (det > 0), det, np.nan), np.float64)


def point_covariance(
    xyz: FloatArray, K: FloatArray, point_index: IntArray, T_cam_w: FloatArray, sigma: FloatArray
) -> FloatArray:
    """Return the covariance of each point given the poses of the cameras that see it: the inverse of sum J'J / sigma^2.

    - `xyz` (N, 3): points in w.
    - `K` (3, 3): intrinsics, zero skew.
    - `point_index` (O,): row of `xyz` that each observation is of; any order.
    - `T_cam_w` (O, 4, 4): pose of the camera of each observation.
    - `sigma` (O,): pixel standard deviation of each observation.

    Returns (N, 3, 3): in w; NaN where the views do not fix the point (fewer than two, no parallax, a point behind its
    camera).
    """
    T = np.asarray(T_cam_w, np.float64)
    R = T[:, :3, :3]
    p = (R @ xyz[point_index][..., None])[..., 0] + T[:, :3, 3]
    z = np.where(p[:, 2] > 0, p[:, 2], np.nan)
    J = (R[:, :2] - (p[:, :2] / z[:, None])[..., None] * R[:, 2:]) / z[:, None, None]
    J *= np.array([K[0, 0], K[1, 1]])[:, None] / np.asarray(sigma, np.float64)[:, None, None]
    information = symmetric3.planes(J.swapaxes(1, 2) @ J)
    H = np.stack([np.bincount(point_index, plane, len(xyz)) for plane in information]).astype(np.float64)
    return symmetric3.matrices(_inverse_or_nan(H))
