"""Textured images with known geometry, and hand-made features, for the tests of the front ends."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dualslam.core.types import Features


def textured(height: int, width: int, seed: int = 0) -> NDArray[np.uint8]:
    """Random blobs and rectangles of many sizes, slightly blurred as a lens would."""
    rng = np.random.default_rng(seed)
    image = np.full((height, width), 128, np.uint8)
    for _ in range(height * width // 250):
        u, v = int(rng.integers(width)), int(rng.integers(height))
        size = rng.integers(3, 25, 2)
        grey = int(rng.integers(256))
        if rng.random() < 0.5:
            cv2.ellipse(image, (u, v), (int(size[0]), int(size[1])), float(rng.uniform(0, 180)), 0, 360, grey, -1)
        else:
            cv2.rectangle(image, (u, v), (u + int(size[0]), v + int(size[1])), grey, -1)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.8), np.uint8)


def made_up_features(n: int, seed: int, width: float = 640.0, height: float = 480.0) -> Features:
    """Features at random places with random descriptors."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform((0, 0), (width, height), (n, 2))
    octave = rng.integers(0, 4, n)
    scale = 1.2**octave
    angle = rng.uniform(-np.pi, np.pi, n)
    return Features(uv, uv, 0.5 * scale, scale, octave, angle, rng.integers(0, 256, (n, 32), dtype=np.uint8))


@pytest.fixture(scope="session")
def image() -> NDArray[np.uint8]:
    """A (480, 640) textured image."""
    return textured(480, 640)
