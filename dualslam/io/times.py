"""Timestamps of the frames of a sequence: read, checked, or made up at a stated rate."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from dualslam.core.errors import InputError
from dualslam.core.types import FloatArray
from dualslam.io.trajectory_files import read_number_table

NOMINAL_RATE_HZ = 30.0
LATEST_S = 1e11
"""Beyond the year 5000: such numbers are epoch times in milliseconds or smaller units."""


def read_times(path: Path) -> FloatArray:
    """Read a file of seconds, one a line, and check them."""
    return checked_times(read_number_table(path, 1, "a list of times (seconds, one a line)").ravel(), str(path))


def checked_times(times_s: ArrayLike, where: str) -> FloatArray:
    """Return `times_s` as an array if every one is finite and later than the one before.

    Raises
    ------
    InputError
        Naming `where` and the first entry that is wrong.
    """
    times = np.asarray(times_s, float).ravel()
    if not np.isfinite(times).all():
        bad = int(np.argmin(np.isfinite(times)))
        raise InputError(f"{where}: time {bad + 1} is {times[bad]}; every frame needs a finite time in seconds.")
    if len(times) and np.abs(times).max() > LATEST_S:
        bad = int(np.argmax(np.abs(times)))
        raise InputError(f"{where}: time {bad + 1} is {times[bad]:.0f}, which are no seconds; times are in seconds.")
    step = np.diff(times)
    if (step <= 0).any():
        bad = int(np.argmax(step <= 0)) + 1
        raise InputError(
            f"{where}: time {bad + 1} ({times[bad]:.6f}) is not later than the one before ({times[bad - 1]:.6f}); "
            "times must increase from frame to frame."
        )
    return times


def resolve_times(times: str | Path | ArrayLike, n_images: int, images: Path) -> FloatArray:
    """Return the caller's own times (a file, or numbers) for `n_images` frames."""
    if isinstance(times, str | Path):
        where, found = str(times), read_times(Path(times))
    else:
        where = "the given times"
        found = checked_times(times, where)
    check_count(len(found), where, n_images, images)
    return found


def check_count(n_times: int, where: str | Path, n_images: int, images: Path) -> None:
    """Refuse a sequence that has not one time for each image."""
    if n_times != n_images:
        raise InputError(
            f"{where} has {n_times} times, but {images} has {n_images} images; there must be one time for each image."
        )
