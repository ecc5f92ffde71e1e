"""Robust weights of squared residuals."""

from __future__ import annotations

import numpy as np

from dualslam.core.types import FloatArray


def huber_weights(chi2: FloatArray, gate: float) -> FloatArray:
    """Return Huber's weights of squared whitened residuals: 1 up to `gate`, the threshold's square, less beyond."""
    return np.asarray(np.sqrt(gate / np.maximum(chi2, gate)), np.float64)
