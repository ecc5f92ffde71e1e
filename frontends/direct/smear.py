"""The linear smear of an image by the motion of its camera while the shutter is open."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

MIN_LENGTH_PX = 1.2
"""Shorter smears leave an image as it is."""


@dataclass(frozen=True, slots=True)
class Smear:
    """A straight smear, its middle where the pixel was: direction (clockwise from +u) and length in the image."""

    angle_rad: float = 0.0
    length_px: float = 0.0

    def of(self, image: NDArray[np.float32], level: int) -> NDArray[np.float32]:
        """Return a level of a pyramid as the smear leaves it."""
        kernel = _line(self.angle_rad, self.length_px / 2.0**level)
        if kernel is None:
            return image
        return np.asarray(cv2.filter2D(image, cv2.CV_32F, kernel, borderType=cv2.BORDER_REPLICATE), np.float32)

    def about(self) -> list[Smear]:
        """Return the smears half a step away in direction and in length."""
        by = (-0.5, 0.5)
        return [
            *(Smear(self.angle_rad + each * np.pi / N_ANGLES, self.length_px) for each in by),
            *(Smear(self.angle_rad, self.length_px * HALF_STEP**sign) for sign in (-1, 1)),
        ]


SHARP = Smear()
HALF_STEP = 1.25
"""In length: of the ratio of two that are tried."""
LENGTHS_PX = (6.0, 12.0, 24.0, 40.0, 60.0)
"""Smears of an image of 640 pixels that are tried: steps of 1.5 to 2 cost a correlation of 0.02 at most."""
N_ANGLES = 8


def smears(width_px: int) -> list[Smear]:
    """Return the smears that are tried in an image so wide."""
    angles = np.arange(N_ANGLES) * np.pi / N_ANGLES
    return [Smear(float(a), n * width_px / 640) for n in LENGTHS_PX for a in angles]


def _line(angle_rad: float, length_px: float) -> NDArray[np.float32] | None:
    """Return the kernel of a smear; None where it is too short to matter."""
    if length_px < MIN_LENGTH_PX:
        return None
    half = int(np.ceil(length_px / 2)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    along = np.linspace(-length_px / 2, length_px / 2, max(int(4 * length_px), 9))
    x, y = half + along * np.cos(angle_rad), half + along * np.sin(angle_rad)
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = x - column, y - row
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        weight = (fy if down else 1 - fy) * (fx if right else 1 - fx)
        np.add.at(kernel, (row + down, column + right), weight)
    return np.asarray(kernel / kernel.sum(), np.float32)
