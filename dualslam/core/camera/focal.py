"""Result of a search for an unknown camera."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.camera.models import DivisionCamera, PinholeCamera

SIGMAS_90 = 1.645
"""Of the normal distribution: 90 % lie between."""


@dataclass(frozen=True, slots=True)
class ToldFocal:
    """The focal length that a source's own data tell."""

    over_side: float  # over the image's longer side, however the camera was held
    log_sigma: float  # standard deviation of its logarithm


@dataclass(frozen=True, slots=True)
class FocalSearch:
    """Result of the search."""

    focal_px: float
    log_sigma: float  # standard deviation of its logarithm
    lens: float
    """Of the division model, at half the longer side: an undistorted radius is r / (1 + lens r^2); zero: none."""
    # Of the image, pixels.
    width: int
    height: int
    n_pairs: int  # of frames, that had an answer
    told_px: float | None = None  # focal length by the EXIF data of the first image, or by the container of the video

    @property
    def range_px(self) -> tuple[float, float]:
        """Between what the focal length lies, to 90 %."""
        factor = math.exp(SIGMAS_90 * self.log_sigma)
        return self.focal_px / factor, self.focal_px * factor

    @property
    def fov_deg(self) -> float:
        """Horizontal field of view, the lens left out."""
        return self._fov_deg(self.focal_px)

    @property
    def fov_range_deg(self) -> tuple[float, float]:
        """The field of view's range: the smallest belongs to the largest focal length."""
        low, high = self.range_px
        return self._fov_deg(high), self._fov_deg(low)

    def _fov_deg(self, focal_px: float) -> float:
        return float(np.degrees(2.0 * np.arctan(0.5 * self.width / focal_px)))

    def camera(self) -> Camera:
        """Return the camera, with its principal point in the middle."""
        f, radius = self.focal_px, 0.5 * max(self.width, self.height)
        middle = (0.5 * (self.width - 1), 0.5 * (self.height - 1))
        if self.lens == 0.0:
            return PinholeCamera(self.width, self.height, f, f, *middle)
        return DivisionCamera(self.width, self.height, f, f, *middle, k=self.lens * (f / radius) ** 2)

    def as_dict(self) -> dict[str, Any]:
        """Return it as ``summary.json`` has it."""
        return {
            "focal_px": self.focal_px,
            "focal_range_px": list(self.range_px),
            "fov_deg": self.fov_deg,
            "fov_range_deg": list(self.fov_range_deg),
            "lens": self.lens,
            "pairs": self.n_pairs,
            "told_px": self.told_px,
        }
