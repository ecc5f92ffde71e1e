"""The noise of an image, told from what it shows."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dualslam.frontends.features.images import estimate_noise, noise_of_levels
from tests.frontends.conftest import textured


def noisy(image: NDArray[np.uint8], sigma: float, seed: int = 0) -> NDArray[np.uint8]:
    grain = sigma * np.random.default_rng(seed).standard_normal(image.shape)
    return np.clip(np.rint(image + grain), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("sigma", [1.0, 2.0, 5.0])
def test_noise_is_told_from_texture_and_blur(sigma: float) -> None:
    # A quiet strip is enough; nothing of the rest is.
    image = textured(480, 640)
    image[:64] = 90
    for scene in (image, np.asarray(cv2.GaussianBlur(image, (0, 0), 5.0), np.uint8)):
        assert estimate_noise(noisy(scene, sigma)) == pytest.approx(sigma, rel=0.15)


def test_cut_off_noise_does_not_count() -> None:
    image = np.full((240, 320), 120, np.uint8)
    image[:120] = 0
    image[120:180] = 255
    assert estimate_noise(noisy(image, 2.0)) == pytest.approx(2.0, rel=0.15)
    assert estimate_noise(np.zeros((240, 320), np.uint8)) == 0.0
    assert estimate_noise(np.full((3, 500), 100, np.uint8)) == 0.0


def test_noise_of_a_pyramid_is_what_its_levels_show() -> None:
    # The filter that the corners are judged by, over levels made as the front end makes them.
    level = noisy(np.full((480, 640), 120, np.uint8), 2.0)
    predicted = noise_of_levels(2.0, 8, 1.2)
    assert predicted[0] == 2.0
    for octave in range(8):
        fine, coarse = (cv2.GaussianBlur(level.astype(np.float32), (13, 13), s) for s in (1.0, 1.6))
        response = (fine - coarse)[8:-8, 8:-8]
        measured = (response[:, 2:] - 2 * response[:, 1:-1] + response[:, :-2]).std() / 0.165
        # On the safe side, and not far off.
        assert 0.7 * predicted[octave] < measured < 1.05 * predicted[octave]
        size = (round(640 / 1.2 ** (octave + 1)), round(480 / 1.2 ** (octave + 1)))
        level = np.asarray(cv2.resize(level, size, interpolation=cv2.INTER_LINEAR), np.uint8)
