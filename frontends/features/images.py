"""Preparation of an image for any front end."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.errors import InputError


def to_grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image as contiguous (H, W) uint8.

    `image` (H, W) or (H, W, 3) RGB uint8.

    Raises `InputError`: the array is no such image.
    """
    if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)) or image.size == 0:
        raise InputError(f"an image must be (H, W) or (H, W, 3) uint8, not {image.shape} {image.dtype}")
    if image.ndim == 3:
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY), np.uint8)
    return np.ascontiguousarray(image)


def to_rgb(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The same image as contiguous (H, W, 3) uint8; three like channels where it is grey."""
    if image.ndim == 2:
        image = np.repeat(image[:, :, None], 3, axis=2)
    return np.ascontiguousarray(image)
