"""Lens and sensor: from the rendered scene to the image a camera would deliver."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.lab.synthetic.events import Disturbance

U8Image = NDArray[np.uint8]

_GAMMA = 2.2
VIGNETTING = 0.3
"""Part of the light lost in the corners."""


class Sensor:
    """A lens that is a little soft and dark in the corners, and a noisy sensor.

    Parameters
    ----------
    seed : int
    width, height : int
        Image size, pixels.
    blur_px : float
        Standard deviation of the lens' blur in focus.
    noise : float
        Standard deviation, grey levels.
    stops : float
        Exposure, relative to textures as they are painted.
    """

    def __init__(
        self,
        seed: int,
        width: int,
        height: int,
        blur_px: float = 0.6,
        noise: float = 1.8,
        stops: float = 0.0,
    ) -> None:
        self._seed = seed
        self._size = (width, height)
        self._blur_px = blur_px
        self._noise = noise
        self._stops = stops
        x, y = np.linspace(-1, 1, width)[None, :], np.linspace(-1, 1, height)[:, None]
        self._lens = ((1 - VIGNETTING * (x**2 + y**2) / 2) ** (1 / _GAMMA)).astype(np.float32)

    def expose(self, scene: U8Image, index: int, what: Disturbance) -> U8Image:
        """Return the image (H, W) uint8 of frame `index`, given the rendered scene and its disturbances."""
        width, height = self._size
        image = scene
        if what.wipe:
            # Coarse shading remains: fog or a blank wall is lit unevenly too.
            flat = cv2.resize(cv2.resize(scene, (6, 4), interpolation=cv2.INTER_AREA), (width, height))
            flat = cv2.GaussianBlur(flat, (0, 0), width / 20)
            image = np.asarray(cv2.addWeighted(scene, 1 - what.wipe, flat, what.wipe, 0), np.uint8)
        blur_px = float(np.hypot(self._blur_px, what.blur_px * width / 640))
        if blur_px > 0:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), blur_px), np.uint8)
        gain = (what.light * 2.0 ** (self._stops + what.exposure_stops)) ** (1 / _GAMMA)
        exposed = cv2.multiply(image, self._lens, scale=gain, dtype=cv2.CV_32F)
        # Drawn anew for each frame: windows of one sheet of noise would be a world of their own. A SLAM system would
        # find and map it as soon as the lens is covered.
        rng = np.random.Generator(np.random.SFC64([self._seed, 0x5E45, index]))
        grain = rng.standard_normal((height, width), dtype=np.float32)
        sigma = float(np.hypot(self._noise, what.noise))
        return np.asarray(cv2.addWeighted(exposed, 1.0, grain, sigma, 0.0, dtype=cv2.CV_8U), np.uint8)
