"""Geometry of two views: epipolar and homography errors, and the poses that a homography allows.

Everywhere ``T_b_a`` takes camera a to camera b, ``x_b' E x_a == 0`` and ``u_b ~ H u_a``. Pixels are rectified (u, v).
Sources: R. Hartley and A. Zisserman, "Multiple View Geometry", 2004 (HZ); Y. Ma et al., "An Invitation to 3-D Vision",
2004 (Ma), section 5.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualslam.core.geometry import se3, so3
from dualslam.core.types import FloatArray

MIN_SINGULAR_GAP = 1e-7
"""Difference of the outer singular values of a homography (middle one 1) below which it is a rotation: |t| / d."""


def _homogeneous(uv: FloatArray) -> FloatArray:
    """Return (3, N) homogeneous pixels."""
    return np.vstack([uv.T, np.ones(len(uv))])


def essential_from_pose(T_b_a: FloatArray) -> FloatArray:
    """Return E = hat(t) R, (3, 3), with ``x_b' E x_a == 0`` for normalised image points. HZ, eq. (9.12)."""
    return so3.hat(T_b_a[:3, 3]) @ T_b_a[:3, :3]


def fundamental_from_pose(K: FloatArray, T_b_a: FloatArray) -> FloatArray:
    """Return F, (3, 3), with ``u_b' F u_a == 0`` for pixels of two images with the same K."""
    K_inv = np.linalg.inv(K)
    return np.asarray(K_inv.T @ essential_from_pose(T_b_a) @ K_inv, np.float64)


def sampson_error(F: FloatArray, uv_a: FloatArray, uv_b: FloatArray) -> FloatArray:
    """Return the first-order squared geometric error, (N,), px^2. HZ, eq. (11.9).

    It is about the summed squared pixel error of both images at the best 3D point: chi-square, one degree of freedom.
    """
    c, gradient2 = _epipolar_constraint(F, uv_a, uv_b)
    return np.asarray(c * c / gradient2, np.float64)


def sampson_distance(F: FloatArray, uv_a: FloatArray, uv_b: FloatArray) -> FloatArray:
    """Return what `sampson_error` is the square of, (N,), px, with its sign: smooth in F."""
    c, gradient2 = _epipolar_constraint(F, uv_a, uv_b)
    return np.asarray(c / np.sqrt(gradient2), np.float64)


def _epipolar_constraint(F: FloatArray, uv_a: FloatArray, uv_b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ``u_b' F u_a``, (N,), and the squared length of its gradient by the four pixel coordinates."""
    a, b = _homogeneous(uv_a), _homogeneous(uv_b)
    line_b, line_a = F @ a, F.T @ b
    c = np.einsum("ij,ij->j", b, line_b)
    gradient2 = line_a[0] ** 2 + line_a[1] ** 2 + line_b[0] ** 2 + line_b[1] ** 2
    return c, np.maximum(gradient2, 1e-300)


def homography_transfer_error(H_b_a: FloatArray, uv_a: FloatArray, uv_b: FloatArray) -> FloatArray:
    """Return squared transfer errors of a homography in both directions.

    - `uv_a`, `uv_b` (N, 2).
    - `H_b_a` (3, 3): pixels of a to pixels of b.

    Returns (N, 2), px^2: in image a (b transferred back), in image b. Infinite where a pixel is sent to infinity.
    """
    forward, back = H_b_a @ _homogeneous(uv_a), np.linalg.inv(H_b_a) @ _homogeneous(uv_b)
    errors = []
    for moved, target in ((back, uv_a), (forward, uv_b)):
        w = np.where(moved[2] == 0, np.nan, moved[2])
        error2 = ((moved[:2] / w - target.T) ** 2).sum(0)
        errors.append(np.where(np.isnan(error2), np.inf, error2))
    return np.stack(errors, 1)


@dataclass(frozen=True, slots=True, eq=False)
class HomographyPoses:
    """The poses that a homography of a plane allows, M of them: four, or one where it is a mere rotation."""

    T_b_a: FloatArray  # (M, 4, 4): translations in units of the distance of the plane from camera a
    normal_a: FloatArray
    """(M, 3): unit normal, ``normal_a' X_a`` is the distance: it points away from a camera a before the plane."""


def decompose_homography(H_b_a: FloatArray, K: FloatArray) -> HomographyPoses:
    """Return the poses and planes that a homography of pixels allows. Ma, section 5.3.3.

    The sign of `H_b_a` makes its determinant positive, as it is when both cameras are on the same side of the plane.
    Two of the four poses are ruled out by the positive depth of the points.

    - `K` (3, 3).
    - `H_b_a` (3, 3): pixels of a to pixels of b, any scale, not singular.
    """
    H = np.linalg.inv(K) @ H_b_a @ K
    H = H * np.sign(np.linalg.det(H))
    H = H / np.linalg.svd(H, compute_uv=False)[1]
    _, s, Vt = np.linalg.svd(H)
    if s[0] - s[2] < MIN_SINGULAR_GAP:
        R = so3.orthonormalise(H)
        return HomographyPoses(se3.from_parts(R, np.zeros(3))[None], np.array([[0.0, 0.0, 1.0]]))
    # Rotations of the right singular vectors with positive determinant leave all formulas as they are.
    v1, v2, v3 = Vt * np.sign(np.linalg.det(Vt))
    low, high = np.sqrt(max(1.0 - s[2] ** 2, 0.0)), np.sqrt(max(s[0] ** 2 - 1.0, 0.0))
    span = np.sqrt(s[0] ** 2 - s[2] ** 2)
    poses, normals = [], []
    for u in ((low * v1 + high * v3) / span, (low * v1 - high * v3) / span):
        normal = np.cross(v2, u)
        U = np.stack([v2, u, normal], 1)
        Hv, Hu = H @ v2, H @ u
        R = so3.orthonormalise(np.stack([Hv, Hu, np.cross(Hv, Hu)], 1) @ U.T)
        t = (H - R) @ normal
        poses += [se3.from_parts(R, t), se3.from_parts(R, -t)]
        normals += [normal, -normal]
    return HomographyPoses(np.array(poses), np.array(normals))
