"""Timestamps of the frames of a sequence: read, checked, brought to seconds, or made up at a stated rate."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from dualslam.core.errors import InputError
from dualslam.core.types import FloatArray
from dualslam.io.images import fill_gaps
from dualslam.io.trajectory_files import read_number_table

log = logging.getLogger(__name__)

NOMINAL_RATE_HZ = 30.0
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
UNIT_NAMES = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
RATE_HZ = (0.5, 1000.0)
"""Of a camera whose images overlap: slower, a walk moves metres between them; faster, no camera of images is."""
LIKELY_HZ = (1.0, 500.0)
"""By which a unit is recognised."""
RATE = "the rate of the frames (--rate HZ)"
"""For messages."""
EPOCH_S = (1e9, 4.1e9)
"""The years 2001 to 2099. In a smaller unit such times have 13 digits or more, which no other clock reaches soon."""


def read_times(path: Path) -> FloatArray:
    """Read a file of seconds, one a line, and check them."""
    return checked_times(read_number_table(path, 1, "a list of times (seconds, one a line)").ravel(), str(path))


def checked_times(times_s: ArrayLike, where: str) -> FloatArray:
    """Return `times_s` as an array if every one is finite and later than the one before.

    Raises `InputError`: naming `where` and the first entry that is wrong.
    """
    times = np.asarray(times_s, float).ravel()
    if not np.isfinite(times).all():
        bad = int(np.argmin(np.isfinite(times)))
        raise InputError(f"{where}: time {bad + 1} is {times[bad]}; every frame needs a finite time in seconds.")
    step = np.diff(times)
    if (step <= 0).any():
        bad = int(np.argmax(step <= 0)) + 1
        raise InputError(
            f"{where}: time {bad + 1} ({times[bad]:.6f}) is not later than the one before ({times[bad - 1]:.6f}); "
            "times must increase from frame to frame."
        )
    return times


def epoch_unit(time: float) -> str | None:
    """Return the unit below seconds in which a number is a time of this century; None where it is none."""
    return next((u for u in ("ms", "us", "ns") if EPOCH_S[0] < time * UNITS[u] < EPOCH_S[1]), None)


def in_seconds(times: FloatArray, where: str, unit: str | None) -> FloatArray:
    """Return times in seconds: of the stated unit, or of an epoch's; otherwise they must make a camera's rate.

    Raises `InputError` if their rate is none of a camera, with the unit that they seem to have; or if they count
    frames.
    """
    if unit is not None:
        return times * UNITS[unit]
    epoch = epoch_unit(float(times[0])) if len(times) else None
    if epoch is not None:
        log.warning("%s: its times are read as %s since 1970", where, UNIT_NAMES[epoch])
        times = times * UNITS[epoch]
    if len(times) < 3:
        return times
    steps = np.diff(times)
    rate_hz = 1.0 / float(np.median(steps))
    likely = [u for u in UNITS if u != "s" and LIKELY_HZ[0] <= rate_hz / UNITS[u] <= LIKELY_HZ[1]]
    say = f"give {RATE}, or the unit of the times (--time-unit"
    if not RATE_HZ[0] <= rate_hz <= RATE_HZ[1]:
        seem = f", but {rate_hz / UNITS[likely[0]]:.3g} Hz as {UNIT_NAMES[likely[0]]}" if likely else ""
        raise InputError(
            f"{where}: its times are {1.0 / rate_hz:.3g} apart: {rate_hz:.3g} Hz as seconds{seem}; {say} "
            f"{likely[0] if likely else 's'}{', or s if they are seconds' if likely else ' if they are seconds'})."
        )
    if epoch is None and times[0] < EPOCH_S[0] and (times % 1.0 == 0.0).all():
        raise InputError(f"{where}: its times count frames ({times[0]:.0f}, {times[1]:.0f}, ...); {say} s).")
    return times


def times_in_names(paths: list[Path]) -> FloatArray | None:
    """Return the epoch times, in seconds, by which images are named; None where the names are none.

    Names end in a whole number of milli-, micro- or nanoseconds, or seconds with a fraction.
    """
    found = []
    for path in paths:
        named = re.search(r"([0-9]+)(?:\.([0-9]+))?$", path.stem)
        whole, fraction = named.groups() if named else ("0", None)
        unit = epoch_unit(float(whole))
        if unit is not None and not fraction:
            per_second = round(1.0 / UNITS[unit])
            # Whole numbers first: nanoseconds of an epoch time do not fit a float, its seconds fit to 0.2 microseconds.
            found.append(int(whole) // per_second + int(whole) % per_second * UNITS[unit])
        elif fraction and EPOCH_S[0] < int(whole) < EPOCH_S[1]:
            found.append(float(f"{whole}.{fraction}"))
        else:
            return None
    times = np.array(found)
    return times if len(times) > 1 and (np.diff(times) > 0).all() else None


def recorded_times(path: Path, paths: list[Path], rate_hz: float | None) -> tuple[FloatArray, list[Path]]:
    """Return the times of a sequence's images, by its file of seconds, and the images with those that are lost.

    `rate_hz`: of a sequence without the file; without either it is refused.
    """
    if rate_hz is not None and not path.exists():
        return np.arange(len(paths)) / rate_hz, paths
    times_s = read_times(needed_file(path, RATE))
    paths = fill_gaps(paths, len(times_s))
    check_count(len(times_s), path, len(paths), paths[0].parent)
    return times_s, paths


def needed_file(path: Path, instead: str) -> Path:
    """Return the path of a file that a sequence must have, or refuse it with what can be given `instead`."""
    if not path.exists():
        raise InputError(f"{path} does not exist; it belongs to the sequence: fetch it, or give {instead}.")
    return path


def check_count(n_times: int, where: str | Path, n_images: int, images: Path) -> None:
    """Refuse a sequence that has not one time for each image."""
    if n_times != n_images:
        raise InputError(
            f"{where} has {n_times} times, but {images} has {n_images} images; there must be one time for each image."
        )
