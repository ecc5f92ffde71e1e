"""Rigid poses: the group SE(3) as (4, 4) matrices.

Tangent vectors are (..., 6): rotation (radians) first, then translation. A left perturbation is ``exp(xi) @ T`` (xi in
the frame a of ``T_a_b``). A right one is ``T @ exp(xi)`` (xi in b). Source: T. Barfoot, "State Estimation for
Robotics", 2017, chapter 7, reordered (Barfoot puts translation first).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import factorial

import numpy as np
from numpy.typing import ArrayLike

from dualslam.core.geometry import so3
from dualslam.core.types import FloatArray

DOF = 6
"""Numbers that a small motion has."""
IDENTITY = np.eye(4)
IDENTITY.setflags(write=False)

_C3 = [(-1.0) ** k / factorial(2 * k + 3) for k in range(so3.N_TERMS)]
_C4 = [(-1.0) ** k / factorial(2 * k + 4) for k in range(so3.N_TERMS)]
_C5 = [(-1.0) ** k * (k + 1) / factorial(2 * k + 5) for k in range(so3.N_TERMS)]


def from_parts(R: ArrayLike, t: ArrayLike) -> FloatArray:
    """Assemble poses (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3), broadcast against each other."""
    rotation, translation = np.asarray(R, np.float64), np.asarray(t, np.float64)
    # Most are single poses; what is asked for the others takes three times as long as all the rest.
    single = rotation.ndim == 2 and translation.ndim == 1
    shape = () if single else np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    T = np.zeros((*shape, 4, 4))
    T[..., :3, :3] = rotation
    T[..., :3, 3] = translation
    T[..., 3, 3] = 1.0
    return T


def stack(poses: Sequence[FloatArray]) -> FloatArray:
    """Return (N, 4, 4) of N poses, or none."""
    return np.asarray(poses, np.float64).reshape(-1, 4, 4)


def rotation(T: FloatArray) -> FloatArray:
    """Return a view of the rotations of poses, (..., 4, 4) -> (..., 3, 3)."""
    return T[..., :3, :3]


def translation(T: FloatArray) -> FloatArray:
    """Return a view of the translations of poses, (..., 4, 4) -> (..., 3)."""
    return T[..., :3, 3]


def scaled(T: FloatArray, scale: float | FloatArray) -> FloatArray:
    """Return poses (..., 4, 4) whose translations are so many times as long: in another unit of length."""
    out = T.copy()
    out[..., :3, 3] *= scale
    return out


def hat(xi: ArrayLike) -> FloatArray:
    """Return the matrix of the Lie algebra, (..., 6) -> (..., 4, 4), whose matrix exponential is the pose."""
    x = np.asarray(xi, np.float64)
    X = np.zeros((*x.shape[:-1], 4, 4))
    X[..., :3, :3] = so3.hat(x[..., :3])
    X[..., :3, 3] = x[..., 3:]
    return X


def exp(xi: ArrayLike) -> FloatArray:
    """Return the pose of a tangent vector, (..., 6) -> (..., 4, 4)."""
    x = np.asarray(xi, np.float64)
    t = (so3.left_jacobian(x[..., :3]) @ x[..., 3:, None])[..., 0]
    return from_parts(so3.exp(x[..., :3]), t)


def log(T: ArrayLike) -> FloatArray:
    """Return the tangent vector of a pose, (..., 4, 4) -> (..., 6), rotation in [0, pi]."""
    pose = np.asarray(T, np.float64)
    omega = so3.log(pose[..., :3, :3])
    t = (so3.left_jacobian_inverse(omega) @ pose[..., :3, 3, None])[..., 0]
    return np.concatenate([omega, t], -1)


def inverse(T_a_b: ArrayLike) -> FloatArray:
    """Return ``T_b_a``, (..., 4, 4)."""
    pose = np.asarray(T_a_b, np.float64)
    Rt = np.swapaxes(pose[..., :3, :3], -1, -2)
    return from_parts(Rt, -(Rt @ pose[..., :3, 3, None])[..., 0])


def act(T_a_b: ArrayLike, p_b: ArrayLike) -> FloatArray:
    """Take points from frame b to frame a.

    - `T_a_b` (..., 4, 4): also any affine matrix with last row 0 0 0 1, such as a Sim(3).
    - `p_b` (3,) or (..., N, 3): its leading dimensions broadcast against those of `T_a_b`.

    Returns (..., 3) or (..., N, 3) float64.
    """
    T, p = np.asarray(T_a_b, np.float64), np.asarray(p_b, np.float64)
    if p.ndim == 1:
        return np.asarray(T[..., :3, :3] @ p + T[..., :3, 3], np.float64)
    return np.asarray(p @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3], np.float64)


def act_each(T_a_b: ArrayLike, p_b: ArrayLike) -> FloatArray:
    """Take each point by its own pose: (N, 4, 4), (N, 3) -> (N, 3)."""
    return act(T_a_b, np.asarray(p_b, np.float64)[..., None, :])[..., 0, :]


def adjoint(T: ArrayLike) -> FloatArray:
    """Return Ad with ``T exp(xi) T^-1 == exp(Ad xi)``, (..., 4, 4) -> (..., 6, 6). Barfoot, eq. (7.45)."""
    pose = np.asarray(T, np.float64)
    R = pose[..., :3, :3]
    Ad = np.zeros((*pose.shape[:-2], 6, 6))
    Ad[..., :3, :3] = Ad[..., 3:, 3:] = R
    Ad[..., 3:, :3] = so3.hat(pose[..., :3, 3]) @ R
    return Ad


def _Q(xi: FloatArray) -> FloatArray:
    """Return the coupling block of the left Jacobian. Barfoot, eq. (7.86b)."""
    theta2, theta = so3.safe_angle(xi[..., :3])
    sin, cos = np.sin(theta), np.cos(theta)
    c3 = so3.small_or_closed(theta2, _C3, (theta - sin) / theta**3)[..., None, None]
    c4 = so3.small_or_closed(theta2, _C4, (theta**2 + 2 * cos - 2) / (2 * theta**4))[..., None, None]
    c5 = so3.small_or_closed(theta2, _C5, (2 * theta - 3 * sin + theta * cos) / (2 * theta**5))[..., None, None]
    W, P = so3.hat(xi[..., :3]), so3.hat(xi[..., 3:])
    WP, PW = W @ P, P @ W
    WPW = WP @ W
    out = 0.5 * P + c3 * (WP + PW + WPW) + c4 * (W @ WP + PW @ W - 3 * WPW) + c5 * (WPW @ W + W @ WPW)
    return np.asarray(out, np.float64)


def left_jacobian_inverse(xi: ArrayLike) -> FloatArray:
    """Return the inverse of J with ``exp(xi + d) ~= exp(J d) exp(xi)``, (..., 6, 6). Barfoot, eq. (7.95)."""
    x = np.asarray(xi, np.float64)
    J = np.zeros((*x.shape, 6))
    inv = so3.left_jacobian_inverse(x[..., :3])
    J[..., :3, :3] = J[..., 3:, 3:] = inv
    J[..., 3:, :3] = -inv @ _Q(x) @ inv
    return J


def right_jacobian_inverse(xi: ArrayLike) -> FloatArray:
    """Return the inverse of the right Jacobian, ``J_l(-xi)``."""
    return left_jacobian_inverse(-np.asarray(xi, np.float64))
