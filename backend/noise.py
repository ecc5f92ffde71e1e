"""Noise models, made once and shared by all factors of a kind."""

from __future__ import annotations

import gtsam
import numpy as np

GAUGE_SIGMA = 1e-5
"""Sigma of the priors that fix a gauge (rad, and submap units): tight, yet far from the limits of a double."""
GAUGE_RANGE_RATIO = 1e-4
"""Sigma of the first baseline, relative to its length."""


class PixelNoise:
    """Huber-robust isotropic pixel noise, cached by its sigma: a pyramid has a handful of them.

    Parameters
    ----------
    robust_k : float
        Huber threshold in sigmas.
    """

    def __init__(self, robust_k: float) -> None:
        self._huber = gtsam.noiseModel.mEstimator.Huber.Create(robust_k)
        self._models: dict[float, gtsam.noiseModel.Robust] = {}

    def __call__(self, sigma_px: float) -> gtsam.noiseModel.Robust:
        """Return the model of one standard deviation, pixels."""
        model = self._models.get(sigma_px)
        if model is None:
            isotropic = gtsam.noiseModel.Isotropic.Sigma(2, sigma_px)
            model = self._models[sigma_px] = gtsam.noiseModel.Robust.Create(self._huber, isotropic)
        return model


def pose_sigmas(rotation_rad: float, translation_mu: float) -> gtsam.noiseModel.Diagonal:
    """Return the noise of a pose prior, tangent order rotation, translation."""
    return gtsam.noiseModel.Diagonal.Sigmas(np.array([rotation_rad] * 3 + [translation_mu] * 3))


def gaussian(covariance: np.ndarray) -> gtsam.noiseModel.Gaussian:
    """Return the noise of a full covariance, in GTSAM's tangent order."""
    return gtsam.noiseModel.Gaussian.Covariance(np.asarray(covariance, float))
