"""What is wrong with images as such is told by them."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.lab.synthetic import make_sequence
from dualslam.run.no_map import DARK, FLICKER, MOSAIC, ImageFaults


@pytest.fixture(scope="module")
def frames() -> list[np.ndarray]:
    return [frame.image for frame in make_sequence("room", 6, 0, 320, 240) if frame.image is not None]


def sentence(images: list[np.ndarray]) -> str | None:
    faults = ImageFaults()
    for image in images:
        faults.note(np.clip(image, 0, 255).astype(np.uint8))
    return faults.sentence()


def test_a_scene_and_mere_noise_have_no_fault(frames: list[np.ndarray]) -> None:
    assert sentence([]) is None
    assert sentence(frames) is None
    rng = np.random.default_rng(0)
    assert sentence([rng.integers(0, 256, (240, 320)) for _ in range(4)]) is None
    rows_apart = [np.where(np.arange(240)[:, None] % 2, 0.6 * image, image) for image in frames]
    assert sentence(rows_apart) is None  # half images, as of interlaced video, are no mosaic


def test_a_mosaic(frames: list[np.ndarray]) -> None:
    v, u = np.mgrid[:240, :320]
    gains = np.array([[0.6, 1.0], [1.0, 0.5]])[v % 2, u % 2]
    assert sentence([gains * image for image in frames]) == MOSAIC


def test_night(frames: list[np.ndarray]) -> None:
    rng = np.random.default_rng(0)
    assert sentence([0.03 * image + rng.normal(4, 2.5, image.shape) for image in frames]) == DARK


def test_flicker(frames: list[np.ndarray]) -> None:
    assert sentence([(0.3 if i % 2 else 1.0) * image for i, image in enumerate(frames)]) == FLICKER
    assert sentence([0.8**i * image for i, image in enumerate(frames)]) is None
