"""The variance of residuals, read from maps whose pixels are as good as their sigmas, better or worse."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.backend.noise import MIN_OBSERVATIONS, MIN_VIEWS, residual_variance
from dualslam.core.types import FloatArray, IntArray

LEAST = 0.01


def residuals(n_landmarks: int, n_views: IntArray, sigma: float, seed: int = 0) -> tuple[FloatArray, IntArray]:
    """Fit three numbers to each landmark's views of noise alone, and return what is left, squared, and the views."""
    rng = np.random.default_rng(seed)
    chi2, views = [], []
    for n in rng.choice(n_views, n_landmarks).tolist():
        noise = rng.normal(0.0, sigma, 2 * n)
        basis, _ = np.linalg.qr(rng.normal(size=(2 * n, 3)))
        left = (noise - basis @ (basis.T @ noise)).reshape(n, 2)
        chi2.append((left**2).sum(axis=1))
        views.append(np.full(n, n))
    return np.concatenate(chi2), np.concatenate(views)


@pytest.mark.parametrize("sigma", [0.3, 1.0, 2.0])
@pytest.mark.parametrize("n_views", [[4], [4, 6, 10], [2, 3, 8]], ids=str)
def test_the_variance_is_that_of_the_noise(sigma: float, n_views: list[int]) -> None:
    chi2, views = residuals(900, np.array(n_views), sigma)
    assert residual_variance(chi2, views, LEAST) == pytest.approx(sigma**2, rel=0.1)


def test_outliers_change_it_little() -> None:
    chi2, views = residuals(500, np.array([4, 6, 10]), 0.5)
    chi2[np.random.default_rng(1).random(len(chi2)) < 0.1] = 1000.0
    assert residual_variance(chi2, views, LEAST) == pytest.approx(0.25, rel=0.3)


def test_it_is_never_less_than_asked_for() -> None:
    chi2, views = residuals(500, np.array([6]), 0.2)
    assert residual_variance(chi2, views, 0.36) == 0.36


def test_two_views_that_fit_anything_tell_nothing() -> None:
    chi2, views = residuals(2 * MIN_OBSERVATIONS, np.array([2, MIN_VIEWS - 1]), 0.3)
    assert residual_variance(chi2, views, LEAST) == 1.0


def test_few_observations_tell_nothing() -> None:
    chi2, views = residuals(MIN_OBSERVATIONS // 4 - 1, np.array([4]), 0.3)
    assert residual_variance(chi2, views, LEAST) == 1.0
    assert residual_variance(np.zeros(0), np.zeros(0, np.int64), LEAST) == 1.0
