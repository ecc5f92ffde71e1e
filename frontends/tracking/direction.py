"""The direction of translation between two views: how well they know it, and how far two answers are apart."""

from __future__ import annotations

import numpy as np

from dualslam.core.geometry import se3, so3
from dualslam.core.geometry.projection import projection_jacobians
from dualslam.core.noise_model import TINY
from dualslam.core.types import FloatArray


def direction_sigma_deg(
    K: FloatArray, T_w_a: FloatArray, T_w_b: FloatArray, xyz: FloatArray, sigma_px: FloatArray
) -> float:
    """Standard deviation of the direction from one camera to another, by the two views' Hessian, degrees.

    The points are eliminated by the Schur complement; the scale, which two views cannot tell, is held by its own prior.

    - `K` (3, 3), `T_w_a`, `T_w_b` (4, 4).
    - `xyz` (N, 3): points that both see.
    - `sigma_px` (N,): of their pixels.
    """
    T_a_w, T_b_w = se3.inverse(T_w_a), se3.inverse(T_w_b)
    weight = 1 / sigma_px[:, None, None] ** 2
    H_pp = np.zeros((len(xyz), 3, 3))
    for T_cam_w in (T_a_w, T_b_w):
        J_pose, J_point = projection_jacobians(K, T_cam_w, xyz)
        H_pp += np.einsum("nki,nkj->nij", J_point, J_point) / sigma_px[:, None, None] ** 2
    H_cp = np.einsum("nki,nkj->nij", J_pose, J_point) * weight
    H_cc = (np.einsum("nki,nkj->nij", J_pose, J_pose) * weight).sum(0)
    try:
        S = H_cc - np.einsum("nij,njk,nlk->il", H_cp, np.linalg.inv(H_pp), H_cp)
        t_cam = se3.translation(T_b_w)
        along = np.zeros(se3.DOF)
        along[3:] = t_cam / np.linalg.norm(t_cam)
        S += np.outer(along, along) * np.trace(H_cc)
        covariance = np.linalg.inv(S)[3:, 3:]
    except np.linalg.LinAlgError:
        return float("inf")
    across = so3.IDENTITY - np.outer(along[3:], along[3:])
    variance = float(np.linalg.eigvalsh(across @ covariance @ across)[-1])
    return float(np.degrees(np.sqrt(max(variance, 0.0)) / np.linalg.norm(t_cam)))


def direction_angle_deg(T_1: FloatArray, T_2: FloatArray) -> float:
    """Return the angle between the translations of two poses (4, 4), degrees."""
    t1, t2 = se3.translation(T_1), se3.translation(T_2)
    cosine = t1 @ t2 / max(float(np.linalg.norm(t1) * np.linalg.norm(t2)), TINY)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
