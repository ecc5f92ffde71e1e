"""How noisy an image is, and what that noise looks like to a corner detector. Knows nothing of descriptors."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.quantiles import quantile
from dualslam.core.types import FloatArray

CELL_PX = 16
QUIET_SHARE = 0.1
"""Of the cells this share holds little but noise: the rest of the image may be as rich as it likes."""
ROUNDING_VARIANCE = 1.0 / 12.0
"""Of a grey level that is a whole number."""
_SECOND_DIFFERENCE = np.array([1.0, -2.0, 1.0])
"""Along both axes: blind to planes and to edges along the axes (Immerkaer 1996, Fast noise variance estimation)."""


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
    mean = cv2.resize(high.astype(np.float32), (n_columns, n_rows), interpolation=cv2.INTER_AREA)
    lines = part.reshape(n_rows, CELL_PX, -1)  # whole lines of cells first: long rows are what numpy is quick at
    darkest = lines.min(axis=1).reshape(n_rows, n_columns, CELL_PX).min(axis=2)
    brightest = lines.max(axis=1).reshape(n_rows, n_columns, CELL_PX).max(axis=2)
    whole = (darkest > 0) & (brightest < 255)
    # The mean modulus of a normal variable is sqrt(2 / pi) of its standard deviation; the filter has a norm of 6.
    sigma = np.sqrt(np.pi / 2) / 6 * np.asarray(mean)[whole]
    return float(quantile(sigma, QUIET_SHARE)) if len(sigma) else 0.0


def noise_of_levels(sigma: float, n_levels: int, scale_factor: float) -> FloatArray:
    """Return the noise (L,) that a pyramid's levels have from that of the image, grey levels.

    A pixel of a level averages as many of the level below as it covers, and is rounded again.
    """
    variance = [sigma**2]
    while len(variance) < n_levels:
        variance.append(variance[-1] / scale_factor**2 + ROUNDING_VARIANCE)
    return np.sqrt(variance[:n_levels])
