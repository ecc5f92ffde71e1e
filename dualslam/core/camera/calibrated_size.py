"""The image size that a calibration was made for, by its principal point."""

from __future__ import annotations

import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.chi_square import CHI2_95

PRINCIPAL_POINT_SIGMA = 0.015
"""Standard deviation of the principal point from the middle of the image, relative to its width."""
MIN_FACTOR = 1.25
"""Sizes in use differ by this factor or more (640 and 800, 1024 and 1280 pixels). Most crops move the middle less."""


def find_calibrated_size(camera: Camera) -> tuple[int, int] | None:
    """Return the image size (width, height) that a calibration fits better than that of its camera, if any.

    A calibration of smaller images has its principal point at the middle of those: too far left and too far up by the
    same factor. A crop moves it, too, but seldom by as much, and in this direction.
    """
    size = np.array(camera.size_px, np.float64)
    factor = 2.0 * (np.array([camera.cx, camera.cy]) + 0.5) / size
    sigma = 2.0 * PRINCIPAL_POINT_SIGMA * camera.width / size
    weight = sigma**-2.0
    common = float(weight @ factor / weight.sum())
    if not common > 0:
        return None
    chi2 = float((((factor / common - 1.0) / sigma) ** 2).sum())
    if chi2 > CHI2_95[1] or 1.0 / MIN_FACTOR < common < MIN_FACTOR:
        return None
    width, height = np.rint(common * size).astype(int).tolist()
    return width, height
