"""A folder of images, in natural order; `times.txt`, `calib.txt` and `groundtruth_tum.txt` beside them are read."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from dualslam.core.types import FloatArray
from dualslam.io.camera_files import read_camera_file
from dualslam.io.images import IMAGE_SUFFIXES, ImageFiles, list_images
from dualslam.io.sequence import Given, Recording, image_size
from dualslam.io.times import NOMINAL_RATE_HZ, recorded_times, times_in_names
from dualslam.io.trajectory_files import read_tum

log = logging.getLogger(__name__)


def recognises(folder: Path) -> bool:
    """Tell whether `folder` holds images, itself or in ``images/``."""
    return (folder / "images").is_dir() or any(p.suffix.lower() in IMAGE_SUFFIXES for p in folder.iterdir())


def open_recording(folder: Path, given: Given) -> Recording:
    """Open a folder of images. Without times it is taken to run at the given rate, or at 30 Hz with a warning."""
    times_path, calib_path, truth_path = folder / "times.txt", folder / "calib.txt", folder / "groundtruth_tum.txt"
    where = folder / "images" if (folder / "images").is_dir() else folder
    paths = list_images(where)
    clock = ""
    if times_path.exists():
        clock = str(times_path)
        timestamps_s, paths = recorded_times(times_path, paths, None)
    elif given.rate_hz is None and (named := times_in_names(paths)) is not None:
        log.warning("%s: its images are named by their times, which are taken", where)
        clock, timestamps_s = f"the names of the images in {where}", named
    else:
        timestamps_s = nominal_times(len(paths), given.rate_hz, times_path)
    name, images = folder.resolve().name, ImageFiles(paths)
    calibrated = not given.camera and calib_path.exists()
    return Recording(
        name=name,
        images=images,
        timestamps_s=timestamps_s,
        camera=read_camera_file(calib_path, lambda: image_size(images, name)) if calibrated else None,
        ground_truth=read_tum(truth_path) if truth_path.exists() and clock else None,
        calibration=str(calib_path),
        clock=clock,
    )


def nominal_times(n: int, rate_hz: float | None, times_path: Path) -> FloatArray:
    """Return times of `n` frames at `rate_hz`, by default the nominal rate; `times_path`: where they could stand."""
    if rate_hz is None:
        log.warning("%s would tell the times: without it the images are taken at %g Hz", times_path, NOMINAL_RATE_HZ)
        rate_hz = NOMINAL_RATE_HZ
    return np.arange(n) / rate_hz
