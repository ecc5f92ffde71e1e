"""Preparation of an image for any front end, and how noisy it is."""

from __future__ import annotations

from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.arrays import quantile
from dualslam.core.errors import FrontendError, InputError
from dualslam.core.interfaces import Frontend
from dualslam.core.types import Features, FloatArray

_KINDS = {"uv_px": "f", "uv_rect_px": "f", "sigma_px": "f", "scale": "f", "octave": "iu", "angle_rad": "f"}
"""Of the arrays' types, as numpy has them; `dualslam.frontends.conformance` asks for more."""
CELL_PX = 16
QUIET_SHARE = 0.1
"""Of the cells this share holds little but noise: the rest of the image may be as rich as it likes."""
ROUNDING_VARIANCE = 1.0 / 12.0
"""Of a grey level that is a whole number."""
_SECOND_DIFFERENCE = np.array([1.0, -2.0, 1.0])
"""Along both axes: blind to planes and to edges along the axes (Immerkaer 1996, Fast noise variance estimation)."""


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


def estimate_noise(image: NDArray[np.uint8]) -> float:
    """Return the standard deviation of the noise, grey levels: that of the cells in which least happens.

    Cells that touch black or white, where noise is cut off, do not count; an image without others counts as free of
    noise.

    `image` (H, W) uint8.
    """
    n_rows, n_columns = image.shape[0] // CELL_PX, image.shape[1] // CELL_PX
    if n_rows == 0 or n_columns == 0:
        return 0.0
    part = image[: n_rows * CELL_PX, : n_columns * CELL_PX]
    high = cv2.convertScaleAbs(cv2.sepFilter2D(part, cv2.CV_16S, _SECOND_DIFFERENCE, _SECOND_DIFFERENCE))
    lines = part.reshape(n_rows, CELL_PX, -1)  # whole lines of cells first: long rows are what numpy is quick at
    total = np.asarray(high).reshape(lines.shape).sum(axis=1, dtype=np.uint16).reshape(n_rows, n_columns, CELL_PX)
    darkest = lines.min(axis=1).reshape(n_rows, n_columns, CELL_PX).min(axis=2)
    brightest = lines.max(axis=1).reshape(n_rows, n_columns, CELL_PX).max(axis=2)
    whole = (darkest > 0) & (brightest < 255)
    # The mean modulus of a normal variable is sqrt(2 / pi) of its standard deviation; the filter has a norm of 6.
    sigma = np.sqrt(np.pi / 2) / 6 / CELL_PX**2 * total.sum(axis=2, dtype=np.uint16)[whole]
    return float(quantile(sigma, QUIET_SHARE)) if len(sigma) else 0.0


def noise_of_levels(sigma: float, n_levels: int, scale_factor: float) -> FloatArray:
    """Return the noise (L,) that a pyramid's levels have from that of the image, grey levels.

    A pixel of a level averages as many of the level below as it covers, and is rounded again.
    """
    variance = [sigma**2]
    while len(variance) < n_levels:
        variance.append(variance[-1] / scale_factor**2 + ROUNDING_VARIANCE)
    return np.sqrt(variance[:n_levels])
