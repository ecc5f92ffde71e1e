"""Noise models, made once and shared by all factors of a kind."""

from __future__ import annotations

import gtsam
import numpy as np

from dualslam.core.chi_square import CHI2_99, variance_by_median
from dualslam.core.types import FloatArray, IntArray

OUTLIER_CHI2 = CHI2_99[2]
"""Squared residual, in the residuals' own variance, above which an observation is an outlier: chi-square, 2 degrees of
freedom, 99 %, since what is dropped here is dropped for good."""
LEAST_NOISE = 0.6
"""Standard deviation, in the pixels' sigmas, that gates take residuals to have at least. Landmarks of four views and
more have 0.25 to 0.5, because the error of a lens model is much the same in neighbouring views. Those of fewer views,
seen from further apart, have some more. 1: gates are never tighter than the pixels' sigmas."""

GAUGE_SIGMA = 1e-5
"""Sigma of the priors that fix a gauge (rad, and submap units): tight, yet far from the limits of a double."""
MIN_VIEWS, MIN_OBSERVATIONS = 4, 400
"""Landmarks of so many views, and their observations, that give the residuals' variance: its sigma is then 7 %."""


def residual_variance(chi2: FloatArray, n_views: IntArray, least: float) -> float:
    """Return the variance of whitened residuals that gates go by (`variance_by_median`).

    A lens model's error is much the same in neighbouring views, so that a gate in the pixel's sigmas lets outliers in.

    - `chi2` (R,): squared whitened residuals (2 degrees of freedom) of observations.
    - `n_views` (R,): views that each one's landmark has.
    - `least`: the smallest answer, at most 1.

    Returns float: 1 where too few landmarks have views enough to tell.
    """
    tells = n_views >= MIN_VIEWS
    if np.count_nonzero(tells) < MIN_OBSERVATIONS:
        return 1.0
    return max(least, variance_by_median(chi2[tells], n_views[tells]))


class PixelNoise:
    """Robust isotropic pixel noise (`robust_k`: Huber threshold in sigmas), cached by its sigma."""

    def __init__(self, robust_k: float) -> None:
        self._loss = gtsam.noiseModel.mEstimator.Huber.Create(robust_k)
        self._models: dict[float, gtsam.noiseModel.Robust] = {}

    def __call__(self, sigma_px: float) -> gtsam.noiseModel.Robust:
        """Return the model of one standard deviation, pixels."""
        model = self._models.get(sigma_px)
        if model is None:
            isotropic = gtsam.noiseModel.Isotropic.Sigma(2, sigma_px)
            model = self._models[sigma_px] = gtsam.noiseModel.Robust.Create(self._loss, isotropic)
        return model


def pose_sigmas(rotation_rad: float, translation_mu: float) -> gtsam.noiseModel.Diagonal:
    """Return the noise of a pose prior, tangent order rotation, translation."""
    return gtsam.noiseModel.Diagonal.Sigmas(np.array([rotation_rad] * 3 + [translation_mu] * 3))


def gaussian(covariance: np.ndarray) -> gtsam.noiseModel.Gaussian:
    """Return the noise of a full covariance, in GTSAM's tangent order."""
    return gtsam.noiseModel.Gaussian.Covariance(np.asarray(covariance, float))
