"""A plain folder of images, in natural order, without a calibration of its own."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from dualslam.core.types import FloatArray
from dualslam.io.images import IMAGE_SUFFIXES, ImageFiles, list_images
from dualslam.io.sequence import Given, Recording
from dualslam.io.times import NOMINAL_RATE_HZ, resolve_times

log = logging.getLogger(__name__)


def recognises(folder: Path) -> bool:
    """Tell whether `folder` holds images, itself or in ``images/``."""
    return (folder / "images").is_dir() or any(p.suffix.lower() in IMAGE_SUFFIXES for p in folder.iterdir())


def open_recording(folder: Path, given: Given) -> Recording:
    """Open a folder of images. Without times it is taken to run at the given rate, or at 30 Hz with a warning."""
    where = folder / "images" if (folder / "images").is_dir() else folder
    paths = list_images(where)
    if given.times is not None:
        timestamps_s = resolve_times(given.times, len(paths), where)
    else:
        timestamps_s = nominal_times(len(paths), given.rate_hz, where)
    return Recording(folder.resolve().name, ImageFiles(paths), timestamps_s, camera=None)


def nominal_times(n: int, rate_hz: float | None, where: Path) -> FloatArray:
    """Return times of `n` frames at `rate_hz`, by default the nominal rate."""
    if rate_hz is None:
        log.warning("%s has no times: taken to run at %g Hz; give the rate or a file of times.", where, NOMINAL_RATE_HZ)
        rate_hz = NOMINAL_RATE_HZ
    return np.arange(n) / rate_hz
