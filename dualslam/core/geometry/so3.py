"""Rotations: the group SO(3) with exponential, logarithm, Jacobians and quaternions.

All functions take arrays with any leading dimensions. Tangent vectors are rotation vectors in radians. Sources: J. Sola
et al., "A micro Lie theory for state estimation in robotics", 2018; T. Barfoot, "State Estimation for Robotics", 2017.
"""

from __future__ import annotations

import math
from math import factorial

import numpy as np
from numpy.typing import ArrayLike

from dualslam.core.types import FloatArray

IDENTITY = np.eye(3)
IDENTITY.setflags(write=False)
SERIES_BELOW_RAD2 = 1.0
"""Squared angle under which coefficients with cancellation are summed as series (error then below 1e-16)."""
N_TERMS = 12
FEW = 4
"""Numbers that Python sums a series of sooner than numpy."""

_C3 = [(-1.0) ** k / factorial(2 * k + 3) for k in range(N_TERMS)]
# |B_2n| / (2n)!, the series of (1 - x/2 cot(x/2)) / x^2 in x^2.
_COT = [1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160, 691 / 1307674368000, 1 / 74724249600]
_COT += [_COT[-1] / (4 * np.pi**2) ** k for k in range(1, 6)]  # zeta(2n) = 1 to 5 digits from here on


def series(x: FloatArray, coefficients: list[float]) -> FloatArray:
    """Sum ``coefficients[k] * x**k`` by Horner's rule, elementwise."""
    if x.size <= FEW:
        return np.array([_sum_at(each, coefficients) for each in x.ravel().tolist()]).reshape(x.shape)
    total = np.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        total = total * x + c
    return total


def _sum_at(x: float, coefficients: list[float]) -> float:
    total = coefficients[-1]
    for c in coefficients[-2::-1]:
        total = total * x + c
    return total


def small_or_closed(theta2: FloatArray, coefficients: list[float], closed: FloatArray) -> FloatArray:
    """Return the series in `theta2` where it is small, the closed form elsewhere."""
    small = theta2 < SERIES_BELOW_RAD2
    return np.where(small, series(np.where(small, theta2, 0.0), coefficients), closed)


def safe_angle(omega: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (squared angle, an angle that is never 0 and so may divide), each of the leading shape."""
    theta2 = (omega * omega).sum(-1)
    return theta2, np.sqrt(np.where(theta2 < SERIES_BELOW_RAD2, 1.0, theta2))


def hat(omega: ArrayLike) -> FloatArray:
    """Return the skew-symmetric matrix of a vector, (..., 3) -> (..., 3, 3): ``hat(a) @ b == cross(a, b)``."""
    w = np.asarray(omega, np.float64)
    out = np.zeros((*w.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = w[..., 2], -w[..., 1], w[..., 0]
    return out


def exp(omega: ArrayLike) -> FloatArray:
    """Return the rotation matrix (..., 3, 3) of a rotation vector (..., 3), radians (Rodrigues' formula)."""
    w = np.asarray(omega, np.float64)
    theta = np.sqrt((w * w).sum(-1))[..., None, None]
    W = hat(w)
    # np.sinc(x) = sin(pi x) / (pi x): exact at zero, no branch.
    out = np.eye(3) + np.sinc(theta / np.pi) * W + 0.5 * np.sinc(theta / (2 * np.pi)) ** 2 * (W @ W)
    return np.asarray(out, np.float64)


def log(R: ArrayLike) -> FloatArray:
    """Return the rotation vector (..., 3), radians, of a rotation matrix (..., 3, 3), its norm in [0, pi].

    It goes by way of the quaternion, so it is safe near pi.
    """
    q = quat_xyzw_from_matrix(R)
    v, w = q[..., :3], q[..., 3]
    n = np.sqrt((v * v).sum(-1))
    small = n < 1e-8
    factor = np.where(small, 2.0, 2.0 * np.arctan2(n, w) / np.where(small, 1.0, n))
    return v * factor[..., None]


def left_jacobian(omega: ArrayLike) -> FloatArray:
    """Return J with ``exp(w + d) ~= exp(J d) exp(w)``, (..., 3) -> (..., 3, 3). Barfoot, eq. (7.77)."""
    w = np.asarray(omega, np.float64)
    theta2, theta = safe_angle(w)
    b = 0.5 * np.sinc(np.sqrt(theta2) / (2 * np.pi)) ** 2
    c = small_or_closed(theta2, _C3, (theta - np.sin(theta)) / theta**3)
    W = hat(w)
    return np.eye(3) + b[..., None, None] * W + c[..., None, None] * (W @ W)


def left_jacobian_inverse(omega: ArrayLike) -> FloatArray:
    """Return the inverse of `left_jacobian`, for angles below 2 pi. Barfoot, eq. (7.76)."""
    w = np.asarray(omega, np.float64)
    theta2, theta = safe_angle(w)
    d = small_or_closed(theta2, _COT, (1.0 - 0.5 * theta / np.tan(0.5 * theta)) / theta**2)
    W = hat(w)
    return np.eye(3) - 0.5 * W + d[..., None, None] * (W @ W)


def right_jacobian_inverse(omega: ArrayLike) -> FloatArray:
    """Return the inverse of the right Jacobian, ``J_l(-xi)``."""
    return left_jacobian_inverse(-np.asarray(omega, np.float64))


def orthonormalise(R: ArrayLike) -> FloatArray:
    """Return the rotation nearest to a matrix in the Frobenius norm: removes the drift of long products.

    `R` (..., 3, 3): nearly a rotation, up to a positive scale.
    """
    U, _, Vt = np.linalg.svd(np.asarray(R, np.float64))
    U[..., :, 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    return np.asarray(U @ Vt, np.float64)


def rotation_angle(R: ArrayLike) -> FloatArray:
    """Return the angle of rotation in [0, pi], radians, (..., 3, 3) -> (...): accurate at both ends of that range."""
    m = np.asarray(R, np.float64)
    w = np.stack([m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], -1)
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    return np.asarray(np.arctan2(np.sqrt((w * w).sum(-1)), trace - 1.0), np.float64)


def quat_xyzw_from_matrix(R: ArrayLike) -> FloatArray:
    """Return unit quaternions (..., 4) of matrices (..., 3, 3), w >= 0 (where w is 0, the first non-zero of x, y, z >
    0).

    Bar-Itzhack's symmetric products: every row of 4 q q' is linear in R; the row of largest norm is free of
    cancellation. (S. Shepperd, "Quaternion from rotation matrix", 1978, without its branches.)
    """
    m = np.asarray(R, np.float64)
    if m.ndim == 2:
        return _quat_of_one(m.tolist())
    a, b, c = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    xw, yw, zw = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    rows = np.stack(
        [
            np.stack([1 + a - b - c, xy, xz, xw], -1),
            np.stack([xy, 1 - a + b - c, yz, yw], -1),
            np.stack([xz, yz, 1 - a - b + c, zw], -1),
            np.stack([xw, yw, zw, 1 + a + b + c], -1),
        ],
        -2,
    )
    best = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.sqrt((q * q).sum(-1, keepdims=True))
    return positive_quat(q)


def _quat_of_one(m: list[list[float]]) -> FloatArray:
    """Return `quat_xyzw_from_matrix` of one matrix in plain floats: the same to the bit, ten times faster."""
    (a, m01, m02), (m10, b, m12), (m20, m21, c) = m
    xy, xz, yz = m01 + m10, m02 + m20, m12 + m21
    xw, yw, zw = m21 - m12, m02 - m20, m10 - m01
    squares = (1 + a - b - c, 1 - a + b - c, 1 - a - b + c, 1 + a + b + c)
    best = squares.index(max(squares))
    rows = ((squares[0], xy, xz, xw), (xy, squares[1], yz, yw), (xz, yz, squares[2], zw), (xw, yw, zw, squares[3]))
    x, y, z, w = rows[best]
    n = math.sqrt(x * x + y * y + z * z + w * w)
    leading = next((each for each in (w, x, y, z) if each != 0), 1.0)
    n = math.copysign(n, leading)
    return np.array([x / n, y / n, z / n, w / n])


def positive_quat(quat_xyzw: FloatArray) -> FloatArray:
    """Return the one of q and -q whose w is positive (ties broken by x, then y, then z): the same rotation."""
    order = quat_xyzw[..., [3, 0, 1, 2]]
    first = np.argmax(order != 0, axis=-1)
    sign = np.sign(np.take_along_axis(order, first[..., None], -1))
    return np.asarray(quat_xyzw * np.where(sign == 0, 1.0, sign), np.float64)


def matrix_from_quat_xyzw(quat_xyzw: ArrayLike) -> FloatArray:
    """Return rotation matrices of quaternions (x, y, z, w), which are normalised first, (..., 4) -> (..., 3, 3)."""
    q = np.asarray(quat_xyzw, np.float64)
    q = q / np.sqrt((q * q).sum(-1, keepdims=True))
    V = hat(q[..., :3])
    return np.asarray(np.eye(3) + 2.0 * q[..., 3, None, None] * V + 2.0 * (V @ V), np.float64)
