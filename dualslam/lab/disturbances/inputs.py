"""Wrong calibrations and wrong clocks: what comes with the images, disturbed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.camera.models import PinholeCamera
from dualslam.core.config.corruption import Corruption, CorruptionKind
from dualslam.core.types import FloatArray, IntArray


def wrong_camera(camera: Camera, corruptions: Iterable[Corruption]) -> Camera:
    """Return the calibration that a run is given instead of the true one.

    Parameters
    ----------
    camera : Camera
    corruptions : iterable of Corruption
        Those of other kinds are ignored.
    """
    for corruption in corruptions:
        factor = corruption.level
        match corruption.kind:
            case CorruptionKind.FOCAL:
                camera = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
            case CorruptionKind.RESOLUTION:
                scaled = camera.scaled(factor)
                camera = replace(camera, fx=scaled.fx, fy=scaled.fy, cx=scaled.cx, cy=scaled.cy)
            case CorruptionKind.NO_DISTORTION:
                camera = PinholeCamera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return camera


class WrongClock:
    """Changes the times of frames, which are asked for in reading order.

    Parameters
    ----------
    corruptions : iterable of Corruption
        Those of other kinds are ignored.
    interval_s : float
        Between neighbouring frames.
    """

    def __init__(self, corruptions: Iterable[Corruption], interval_s: float) -> None:
        self._corruptions = tuple(corruptions)
        self._interval_s = interval_s
        self._shared: dict[Corruption, tuple[int, float]] = {}  # frames that still share a time, and the time

    def time_of(self, index: int, timestamp_s: float) -> float:
        """Return the time that the frame claims."""
        for corruption in self._corruptions:
            if corruption.covers(index):
                timestamp_s = self._changed(corruption, index, timestamp_s)
        return timestamp_s

    def _changed(self, corruption: Corruption, index: int, timestamp_s: float) -> float:
        match corruption.kind:
            case CorruptionKind.CLOCK_UNIT:
                return corruption.level * timestamp_s
            case CorruptionKind.CLOCK_JITTER:
                share = np.random.default_rng([corruption.seed, 0xC10C, index]).random() - 0.5
                return timestamp_s + corruption.level * self._interval_s * float(share)
            case CorruptionKind.CLOCK_REPEAT:
                left, time_s = self._shared.get(corruption, (0, 0.0))
                left, time_s = (left, time_s) if left else (round(corruption.level), timestamp_s)
                self._shared[corruption] = left - 1, time_s
                return time_s
        return timestamp_s

    def times_of(self, index: IntArray, timestamps_s: FloatArray) -> FloatArray:
        """Return the times that all frames (N,) claim."""
        pairs = zip(index.tolist(), timestamps_s.tolist(), strict=True)
        return np.array([self.time_of(i, t) for i, t in pairs], np.float64)
