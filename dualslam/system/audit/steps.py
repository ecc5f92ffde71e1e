"""Steps of a trajectory that do not fit the velocities about them: where two places were joined falsely, say."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualslam.core.types import FloatArray

NEIGHBOURS = 5
"""Steps on either side whose median speed is expected. Five outvote a frame that is off by itself."""
MIN_SPEED_SHARE = 0.5
"""Of the median speed of the whole trajectory, the least that is expected: a camera at rest starts to move."""
MIN_INTERVAL_SHARE = 0.5
"""Of the median interval, the least that a step is taken to have lasted: timestamps repeat, or come late in turns."""


@dataclass(frozen=True, slots=True, eq=False)
class Steps:
    """The steps between N consecutive frames of a trajectory."""

    ratio: FloatArray  # (N - 1,): speed of each step over the speed about it
    excess: FloatArray  # (N - 1,): length beyond what the speed about it explains, in the trajectory's unit


def measure_steps(times_s: FloatArray, centres: FloatArray) -> Steps:
    """Compare each step of a trajectory with the median of those about it.

    - `times_s` (N,): ascending; some may repeat.
    - `centres` (N, 3): of the camera.
    """
    interval_s = np.diff(times_s)
    least_s = MIN_INTERVAL_SHARE * float(np.median(interval_s[interval_s > 0])) if (interval_s > 0).any() else 1e-9
    interval_s = np.maximum(interval_s, least_s)
    length = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    speed = length / interval_s
    if len(speed) <= 2 * NEIGHBOURS:
        return Steps(np.zeros(len(speed)), np.zeros(len(speed)))
    padded = np.concatenate([np.full(NEIGHBOURS, np.nan), speed, np.full(NEIGHBOURS, np.nan)])
    window = np.lib.stride_tricks.sliding_window_view(padded, 2 * NEIGHBOURS + 1)
    about = np.nanmedian(np.delete(window, NEIGHBOURS, axis=1), axis=1)
    expected = np.maximum(about, MIN_SPEED_SHARE * float(np.median(speed)))
    return Steps(speed / np.maximum(expected, 1e-12), length - expected * interval_s)
