"""From pixels of the image to those of the camera's pinhole equivalent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.types import Features, FloatArray


def rectify(features: Features, camera: Camera, model_sigma_px: float) -> Features:
    """Move features to the camera's pinhole equivalent; those that it cannot hold are dropped."""
    uv_rect_px, magnification = camera.rectify(features.uv_px)
    sigma_px = rectified_sigma(features.sigma_px, magnification, model_sigma_px)
    rectified = replace(features, uv_rect_px=uv_rect_px, sigma_px=sigma_px)
    inside = np.isfinite(uv_rect_px).all(axis=1) & np.isfinite(magnification)
    return rectified if inside.all() else rectified.take(inside)


def rectified_sigma(sigma_px: FloatArray, magnification: FloatArray, model_sigma_px: float) -> FloatArray:
    """Return the noise (N,) of rectified pixels, from that of the raw ones and the camera model's error.

    In steps of an eighth of an octave: the graph shares one noise model among all pixels of one sigma.
    """
    return np.asarray(2.0 ** (np.rint(8.0 * np.log2(np.hypot(sigma_px, model_sigma_px) * magnification)) / 8.0))
