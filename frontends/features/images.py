"""Preparation of an image for any front end."""

from __future__ import annotations

from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.errors import FrontendError, InputError
from dualslam.core.interfaces import Frontend
from dualslam.core.types import Features


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


_KINDS = {"uv_px": "f", "uv_rect_px": "f", "sigma_px": "f", "scale": "f", "octave": "iu", "angle_rad": "f"}
"""Of the arrays' types, as numpy has them; `dualslam.frontends.conformance` asks for more."""


def features_of(frontend: Frontend, image: NDArray[np.uint8]) -> Features:
    """Return the features of an image.

    Raises `FrontendError`: as `checked` says.
    """
    return checked(frontend, frontend.extract(image))


def checked(frontend: Frontend, found: object) -> Features:
    """Return what a front end has found, if it is what it should be.

    Raises `FrontendError` if it is not `Features`, or its arrays are of different lengths or of other types.
    """
    ours = type(frontend).__module__.startswith("dualslam.")
    if not ours and (problem := _problem(found)):
        raise FrontendError(
            f"front end '{type(frontend).__module__}:{type(frontend).__qualname__}': extract returned {problem}; "
            "dualslam.frontends.conformance.check_frontend says all that is wrong with it."
        )
    return cast(Features, found)


def _problem(found: object) -> str | None:
    if not isinstance(found, Features):
        return f"a {type(found).__name__}, not dualslam.core.types.Features"
    for name in (*_KINDS, "descriptors"):
        array = getattr(found, name)
        if not isinstance(array, np.ndarray):
            return f"Features whose {name} is a {type(array).__name__}, not a numpy array"
        if array.dtype.kind not in _KINDS.get(name, "biuf"):
            return f"Features whose {name} is of type {array.dtype}"
        per_feature = {"uv_px": (2,), "uv_rect_px": (2,), "descriptors": array.shape[1:2]}.get(name, ())
        if array.shape != (*found.uv_px.shape[:1], *per_feature):
            return f"Features whose {name} is {array.shape}, beside {found.uv_px.shape} of uv_px"
    return None
