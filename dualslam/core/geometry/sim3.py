"""Similarities: the group Sim(3) as (4, 4) matrices ``[[s R, t], [0, 1]]``, so that x -> s R x + t.

Tangent vectors are (..., 7): rotation (radians), translation, log-scale. They are the coordinates of the Lie algebra
``[[hat(w) + l I, u], [0, 0]]``. GTSAM's ``Similarity3`` uses the same numbers, although that class stores another
translation (``t_ours = s t_gtsam``). A left perturbation is ``exp(xi) @ S``, a right one ``S @ exp(xi)``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from dualslam.core.geometry import se3, so3
from dualslam.core.types import FloatArray

DOF = 7
"""Numbers that a small similarity has."""
# The integrals over the one-parameter subgroup are entire functions: Gauss-Legendre gives them to machine precision for
# every angle up to pi and scales within e^+-10, without the singular cases that the closed forms have.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(20)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS

act = se3.act
act_each = se3.act_each


def from_parts(s: ArrayLike, R: ArrayLike, t: ArrayLike) -> FloatArray:
    """Assemble similarities (..., 4, 4) from scales (...), rotations (..., 3, 3) and translations (..., 3)."""
    return se3.from_parts(np.asarray(s, np.float64)[..., None, None] * np.asarray(R, np.float64), t)


def scale(S: ArrayLike) -> FloatArray:
    """Return the scale, (..., 4, 4) -> (...): the cube root of the determinant, so it may come out negative."""
    A = np.asarray(S, np.float64)[..., :3, :3]
    det = (A[..., 0, :] * np.cross(A[..., 1, :], A[..., 2, :])).sum(-1)
    return np.asarray(np.cbrt(det), np.float64)


def rotation(S: ArrayLike) -> FloatArray:
    """Return the rotation matrix, (..., 4, 4) -> (..., 3, 3)."""
    return np.asarray(S, np.float64)[..., :3, :3] / scale(S)[..., None, None]


def translation(S: ArrayLike) -> FloatArray:
    """Return t of x -> s R x + t, (..., 4, 4) -> (..., 3)."""
    return np.array(np.asarray(S, np.float64)[..., :3, 3])


def inverse(S_a_b: ArrayLike) -> FloatArray:
    """Return ``S_b_a``, (..., 4, 4)."""
    s = scale(S_a_b)
    Rt = np.swapaxes(rotation(S_a_b), -1, -2)
    t = -(Rt @ translation(S_a_b)[..., None])[..., 0] / s[..., None]
    return from_parts(1.0 / s, Rt, t)


def act_on_pose(S_a_b: ArrayLike, T_b_cam: ArrayLike) -> FloatArray:
    """Return the rigid ``T_a_cam`` of a camera posed in b: rotation composed, centre transformed, scale left behind."""
    T = np.asarray(T_b_cam, np.float64)
    SA = np.asarray(S_a_b, np.float64) @ T
    return se3.from_parts(rotation(S_a_b) @ T[..., :3, :3], SA[..., :3, 3])


def hat(xi: ArrayLike) -> FloatArray:
    """Return the matrix of the Lie algebra, (..., 7) -> (..., 4, 4), whose matrix exponential is the similarity."""
    x = np.asarray(xi, np.float64)
    X = se3.hat(x[..., :6])
    X[..., :3, :3] += x[..., 6, None, None] * np.eye(3)
    return X


def _V(omega: FloatArray, log_scale: FloatArray) -> FloatArray:
    """Return the matrix with ``t = V u``: the integral of e^(l x) exp(x hat(w)) over x in [0, 1]."""
    theta = np.sqrt((omega * omega).sum(-1))[..., None]
    g = _WEIGHTS * np.exp(log_scale[..., None] * _NODES)
    a = (g * _NODES * np.sinc(theta * _NODES / np.pi)).sum(-1)
    b = (g * 0.5 * (_NODES * np.sinc(theta * _NODES / (2 * np.pi))) ** 2).sum(-1)
    W = so3.hat(omega)
    out = g.sum(-1)[..., None, None] * np.eye(3) + a[..., None, None] * W + b[..., None, None] * (W @ W)
    return np.asarray(out, np.float64)


def exp(xi: ArrayLike) -> FloatArray:
    """Return the similarity of a tangent vector, (..., 7) -> (..., 4, 4)."""
    x = np.asarray(xi, np.float64)
    t = (_V(x[..., :3], x[..., 6]) @ x[..., 3:6, None])[..., 0]
    return from_parts(np.exp(x[..., 6]), so3.exp(x[..., :3]), t)


def log(S: ArrayLike) -> FloatArray:
    """Return the tangent vector of a similarity of positive scale, (..., 4, 4) -> (..., 7)."""
    omega, log_scale = so3.log(rotation(S)), np.log(scale(S))
    u = np.linalg.solve(_V(omega, log_scale), translation(S)[..., None])[..., 0]
    return np.concatenate([omega, u, log_scale[..., None]], -1)


def adjoint(S: ArrayLike) -> FloatArray:
    """Return Ad with ``S exp(xi) S^-1 == exp(Ad xi)``, (..., 4, 4) -> (..., 7, 7)."""
    A, t = np.asarray(S, np.float64), translation(S)
    R = rotation(S)
    Ad = np.zeros((*A.shape[:-2], 7, 7))
    Ad[..., :3, :3] = R
    Ad[..., 3:6, :3] = so3.hat(t) @ R
    Ad[..., 3:6, 3:6] = A[..., :3, :3]
    Ad[..., 3:6, 6] = -t
    Ad[..., 6, 6] = 1.0
    return Ad


def displacement(point: ArrayLike) -> FloatArray:
    """Return the derivative of ``exp(xi) @ point`` by xi at zero, (3,) -> (3, 7)."""
    p = np.asarray(point, np.float64)
    return np.column_stack([-so3.hat(p), np.eye(3), p])


def left_jacobian_inverse(xi: ArrayLike) -> FloatArray:
    """Return the inverse of J with ``exp(xi + d) ~= exp(J d) exp(xi)``, (..., 7) -> (..., 7, 7).

    J is the integral of ``Ad(exp(x xi))`` over x in [0, 1] (Sola et al., eq. (144) integrated), done by quadrature.
    """
    x = np.asarray(xi, np.float64)
    Ad = adjoint(exp(_NODES[:, None] * x[..., None, :]))
    return np.asarray(np.linalg.inv((_WEIGHTS[:, None, None] * Ad).sum(-3)), np.float64)


def right_jacobian_inverse(xi: ArrayLike) -> FloatArray:
    """Return the inverse of the right Jacobian, ``J_l(-xi)``."""
    return left_jacobian_inverse(-np.asarray(xi, np.float64))


def normalise(S: ArrayLike) -> FloatArray:
    """Return the similarity with its rotation made orthonormal again, (..., 4, 4)."""
    return from_parts(scale(S), so3.orthonormalise(rotation(S)), translation(S))
