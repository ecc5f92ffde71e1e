"""Faults of images: a raw colour mosaic, darkness, a brightness that jumps from frame to frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dualslam.core.types import FloatArray

MOSAIC = "the images look like a raw colour mosaic (Bayer), as a sensor gives it: convert them to colour or grey first"
DARK = "the images are too dark: hardly anything in them is above the noise of the sensor"
FLICKER = "the brightness jumps from frame to frame (flicker, or an exposure that alternates): fix the exposure"
MOSAIC_RATIO = 1.15
"""Mean difference of adjacent pixels over that of pixels two apart. Of a scene it is below 1, of noise 1."""
DARK_GREY = 32
"""Grey level that 99 of 100 pixels of a dark image do not reach: an eighth of the range."""
FLICKER_STOPS = 1.0
"""Between an image and the next; an automatic exposure takes several frames for as much."""
MOST = 0.5
"""Share of the images, or of their pairs, that must show it."""
MIN_SIDE_PX = 32
"""Of an image that is looked at for a mosaic."""
STEP = 4
"""Rows and columns of the pixels whose brightness is looked at."""


class ImageFaults:
    """Looks at the images of the frames before there is a map."""

    def __init__(self) -> None:
        self._n = 0
        self._n_mosaic = 0
        self._n_dark = 0
        self._brightness: list[float] = []

    def note(self, image: NDArray[np.uint8]) -> None:
        """Take in the next image, (H, W) or (H, W, 3)."""
        grey = image if image.ndim == 2 else image[..., 1]
        few = grey[::STEP, ::STEP]
        self._n += 1
        self._n_dark += float(np.quantile(few, 0.99)) < DARK_GREY
        self._n_mosaic += _is_mosaic(grey)
        self._brightness.append(float(few.mean()))

    def sentence(self) -> str | None:
        """Return what most images show, without a full stop; None where it is nothing of these."""
        if not self._n:
            return None
        stops: FloatArray = np.abs(np.diff(np.log2(np.maximum(self._brightness, 1.0))))
        for words, share in (
            (MOSAIC, self._n_mosaic / self._n),
            (DARK, self._n_dark / self._n),
            (FLICKER, float((stops > FLICKER_STOPS).mean()) if len(stops) else 0.0),
        ):
            if share > MOST:
                return words
        return None


def _is_mosaic(grey: NDArray[np.uint8]) -> bool:
    """Return whether pixels resemble those two apart more than their neighbours, along rows and along columns."""
    height, width = grey.shape
    if min(height, width) < MIN_SIDE_PX:
        return False
    middle = grey[height // 4 : 3 * height // 4, width // 4 : 3 * width // 4].astype(np.int16)
    for pixels in (middle, middle.T):
        near, far = (float(np.abs(pixels[:, n:] - pixels[:, :-n]).mean()) for n in (1, 2))
        if near <= MOSAIC_RATIO * far:
            return False
    return True
