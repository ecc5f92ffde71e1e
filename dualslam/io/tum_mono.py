"""TUM-Mono: ``images.zip`` or ``images/``, ``camera.txt``, ``times.txt`` (with exposure), ``groundtruthSync.txt``."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from dualslam.core.errors import InputError
from dualslam.core.types import FloatArray
from dualslam.io.camera_files import read_tum_mono_camera
from dualslam.io.images import ImageFiles, ImageStore, ZippedImages, list_images
from dualslam.io.sequence import Given, Recording
from dualslam.io.times import RATE, check_count, checked_times, needed_file
from dualslam.io.trajectory_files import Trajectory, numbered_lines, read_tum

log = logging.getLogger(__name__)


def recognises(folder: Path) -> bool:
    """Tell whether `folder` is a sequence of TUM-Mono, or meant to be."""
    has_images = (folder / "images").is_dir() or (folder / "images.zip").is_file()
    return has_images and ((folder / "camera.txt").is_file() or not (folder / "images").is_dir())


def open_recording(folder: Path, given: Given) -> Recording:
    """Open a sequence folder; images in ``images.zip`` are read in place."""
    images: ImageStore
    if (folder / "images").is_dir():
        images, where = ImageFiles(list_images(folder / "images")), folder / "images"
    else:
        images, where = ZippedImages(folder / "images.zip"), folder / "images.zip"
    times_path, camera_path, truth_path = folder / "times.txt", folder / "camera.txt", folder / "groundtruthSync.txt"
    if given.rate_hz is not None and not times_path.exists():
        timestamps_s, exposure_s = np.arange(len(images)) / given.rate_hz, None
    else:
        timestamps_s, exposure_s = read_times_with_exposure(needed_file(times_path, RATE))
        check_count(len(timestamps_s), times_path, len(images), where)
    if not given.camera:
        needed_file(camera_path, "a camera file")
    return Recording(
        name=folder.resolve().name,
        images=images,
        timestamps_s=timestamps_s,
        camera=None if given.camera else read_tum_mono_camera(camera_path),
        ground_truth=_ground_truth(truth_path),
        exposure_s=exposure_s,
        calibration=str(camera_path),
        clock=str(times_path),
    )


def _ground_truth(path: Path) -> Trajectory | None:
    """Read what motion capture saw: the start and the end of each sequence; the frames between are NaN."""
    if not path.exists():
        return None
    truth = read_tum(path, skip_nan=True)
    if not len(truth):  # a piece from the middle
        log.warning("%s knows the pose of no frame: there is no ground truth", path)
        return None
    return truth


def read_times_with_exposure(path: Path) -> tuple[FloatArray, FloatArray | None]:
    """Read lines ``id seconds [exposure in milliseconds]``; returns seconds, both."""
    rows = [line.split() for _, line in numbered_lines(path)]
    if not rows:
        raise InputError(f"{path} is empty; each line should be `id seconds exposure_ms`.")
    bad = next((i for i, row in enumerate(rows) if len(row) not in (2, 3) or len(row) != len(rows[0])), None)
    if bad is not None:
        raise InputError(f"{path}: entry {bad + 1} has {len(rows[bad])} fields; each is `id seconds exposure_ms`.")
    try:
        times = [float(row[1]) for row in rows]
        exposure = np.array([float(row[2]) for row in rows]) * 1e-3 if len(rows[0]) == 3 else None
    except ValueError:
        raise InputError(f"{path} holds something that is no number; each line is `id seconds exposure_ms`.") from None
    return checked_times(times, str(path)), exposure
