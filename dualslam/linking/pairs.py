"""The matched pairs as measurements of a similarity: distances, normal equations."""

from __future__ import annotations

import numpy as np

from dualslam.core.geometry import se3, sim3, so3, symmetric3
from dualslam.core.types import BoolArray, FloatArray
from dualslam.linking.correspondences import Correspondences
from dualslam.map.submap import Submap


class PairModel:
    """Pairs with their noise: the pixels' noise, and a relative deformation of the maps that grows from the centre.

    - `centre_new`, `centre_old` (3,): medians of the points.
    """

    def __init__(self, pairs: Correspondences, old: Submap, new: Submap, deformation_sigma: float) -> None:
        self.pairs = pairs
        self.centre_old, self.centre_new = np.median(pairs.xyz_old, axis=0), np.median(pairs.xyz_new, axis=0)
        half = deformation_sigma**2 / 2
        for name, xyz, centre, covariance in (
            ("covariance_old", pairs.xyz_old, self.centre_old, pairs.covariance_old),
            ("covariance_new", pairs.xyz_new, self.centre_new, pairs.covariance_new),
        ):
            distance2 = ((xyz - centre) ** 2).sum(1)
            setattr(self, name, covariance + half * distance2[:, None, None] * so3.IDENTITY)
        self.K_old, self.K_new = old.K, new.K
        self.T_old_kf = old.keyframe_poses(pairs.keyframes)
        self.T_new_kf = new.keyframe_poses(pairs.keyframes)
        self.T_kf_old, self.T_kf_new = se3.inverse(self.T_old_kf), se3.inverse(self.T_new_kf)

    # With the deformation's share, half of it in either map.
    covariance_old: FloatArray  # (M, 3, 3)
    covariance_new: FloatArray  # (M, 3, 3)

    def mahalanobis2(self, S_old_new: FloatArray) -> FloatArray:
        """Return the squared Mahalanobis distance of each pair, (M,)."""
        A = S_old_new[:3, :3]
        residual = self.pairs.xyz_old - sim3.act(S_old_new, self.pairs.xyz_new)
        covariance = self.covariance_old + A @ self.covariance_new @ A.T
        return symmetric3.quadratic_inverse(symmetric3.planes(covariance), residual.T)

    def depths_old(self) -> FloatArray:
        """Return the depth (V,) of each view's point in its keyframe, in the old map."""
        return self._depths(self.T_kf_old, self.pairs.xyz_old)

    def depths_new(self) -> FloatArray:
        """Return the same in the new map."""
        return self._depths(self.T_kf_new, self.pairs.xyz_new)

    def _depths(self, T_kf_map: FloatArray, xyz: FloatArray) -> FloatArray:
        T = T_kf_map[self.pairs.view_keyframe]
        return np.asarray((T[:, 2, :3] * xyz[self.pairs.view_pair]).sum(1) + T[:, 2, 3])

    def normal_equations(self, S_old_new: FloatArray, used: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return (H (7, 7), g (7,)) of the used pairs for a small change of the new map about its centre.

        The change is q -> q + w x q + u + l q, q from `centre_new`: rotation (rad), translation (unit of new),
        log-scale. It is a right perturbation of ``S_old_new`` conjugated by the shift to the centre.
        """
        A = S_old_new[:3, :3]
        q = self.pairs.xyz_new[used] - self.centre_new
        residual = self.pairs.xyz_old[used] - sim3.act(S_old_new, self.pairs.xyz_new[used])
        covariance = self.covariance_old[used] + A @ self.covariance_new[used] @ A.T
        adj, det = symmetric3.adjugate(symmetric3.planes(covariance))
        information = symmetric3.matrices(adj / det)
        local = np.empty((len(q), 3, sim3.DOF))
        local[:, :, :3] = -so3.hat(q)
        local[:, :, 3:6] = so3.IDENTITY
        local[:, :, 6] = q
        J = A @ local
        WJ = (information @ J).reshape(-1, sim3.DOF)
        H = J.reshape(-1, sim3.DOF).T @ WJ
        return (H + H.T) / 2, WJ.T @ residual.reshape(-1)


def pixel_chi2(
    K: FloatArray, T_cam_w: FloatArray, xyz: FloatArray, covariance: FloatArray, uv: FloatArray, sigma: FloatArray
) -> FloatArray:
    """Return squared residuals (V,) whitened by the pixels' sigmas and the points' covariances projected."""
    R = se3.rotation(T_cam_w)
    p = se3.act_each(T_cam_w, xyz)
    z = np.where(p[:, 2] > 0, p[:, 2], np.nan)
    focal = np.array([K[0, 0], K[1, 1]])
    x = p[:, :2] / z[:, None]
    residual = uv - (x * focal + K[:2, 2])
    J = (R[:, :2] - x[..., None] * R[:, 2:]) * focal[:, None] / z[:, None, None]
    C = J @ covariance @ J.swapaxes(1, 2)
    a, b, d = C[:, 0, 0] + sigma**2, C[:, 0, 1], C[:, 1, 1] + sigma**2
    u, v = residual.T
    chi2 = (d * u * u - 2 * b * u * v + a * v * v) / (a * d - b * b)
    return np.asarray(np.where(np.isfinite(chi2), chi2, np.inf), np.float64)
