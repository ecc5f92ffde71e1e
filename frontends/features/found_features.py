"""Features made of landmarks that were found again by their pixels."""

from __future__ import annotations

import numpy as np

from dualslam.core.camera.base import Camera, rectified_sigma
from dualslam.core.interfaces import Frontend
from dualslam.core.types import Features, FloatArray, IntArray
from dualslam.frontends.tracking.turning import straighten


def features_found(
    of: Features,
    uv_px: FloatArray,
    sigma_px: FloatArray,
    zoom: FloatArray,
    turn_rad: FloatArray,
    frontend: Frontend,
    camera: Camera,
    model_sigma_px: float,
    readout_turn_rad: FloatArray | None,
) -> tuple[IntArray, Features]:
    """Return which of N features were found at pixels that the camera can rectify, and these as features there.

    - `of`: of another view: the same landmarks.
    - `uv_px` (N, 2): where the new image shows them, as read.
    - `sigma_px`, `zoom`, `turn_rad` (N,): noise of each coordinate; by how much larger the image shows them, and turned
      by which angle.
    - `camera`: the one that rectifies now.
    - `model_sigma_px`: error of its model, see `CameraConfig.model_sigma_px`.
    - `readout_turn_rad` (3,) or None: rotation during the readout that is taken out of the new view's features.
    """
    if readout_turn_rad is not None:
        uv_px = straighten(uv_px, camera, readout_turn_rad)
    uv_rect, magnification = camera.rectify(uv_px)
    row = np.flatnonzero(np.isfinite(uv_rect).all(axis=1) & np.isfinite(magnification))
    of = of.take(row)
    scale = np.maximum(of.scale * zoom[row], 1.0)
    octave = np.rint(np.log(scale) / np.log(frontend.scale_factor)).astype(np.int64)
    octave = np.minimum(octave, frontend.n_octaves - 1)
    sigma = rectified_sigma(sigma_px[row], magnification[row], model_sigma_px)
    angle = of.angle_rad + turn_rad[row]
    return row, Features(uv_px[row], uv_rect[row], sigma, scale, octave, angle, of.descriptors)
