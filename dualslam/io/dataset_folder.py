"""Our own simple layout: ``images/``, ``times.txt``, ``calib.txt`` and, where known, ``groundtruth_tum.txt``."""

from __future__ import annotations

from pathlib import Path

from dualslam.core.errors import InputError
from dualslam.io.camera_files import CALIB_LINE, read_calib_line
from dualslam.io.images import ImageFiles, fill_gaps, list_images
from dualslam.io.sequence import Given, Recording
from dualslam.io.times import check_count, read_times, resolve_times
from dualslam.io.trajectory_files import read_tum


def recognises(folder: Path) -> bool:
    """Tell whether `folder` is of this layout, or meant to be."""
    return (folder / "images").is_dir() and any((folder / f).exists() for f in ("calib.txt", "times.txt"))


def open_recording(folder: Path, given: Given) -> Recording:
    """Open a folder of this layout; what the caller brings himself need not be there."""
    paths = list_images(folder / "images")
    times_path, calib_path, truth_path = folder / "times.txt", folder / "calib.txt", folder / "groundtruth_tum.txt"
    if given.times is not None:
        timestamps_s = resolve_times(given.times, len(paths), folder / "images")
    elif times_path.exists():
        timestamps_s = read_times(times_path)
        paths = fill_gaps(paths, len(timestamps_s))
        check_count(len(timestamps_s), times_path, len(paths), folder / "images")
    else:
        raise InputError(f"{times_path} does not exist; write the time of each image into it, in seconds, one a line.")
    if not given.camera and not calib_path.exists():
        raise InputError(f"{calib_path} does not exist; write one line `{CALIB_LINE}`, or give a camera file.")
    return Recording(
        name=folder.resolve().name,
        images=ImageFiles(paths),
        timestamps_s=timestamps_s,
        camera=None if given.camera else read_calib_line(calib_path),
        ground_truth=read_tum(truth_path) if truth_path.exists() else None,
        calibration=str(calib_path),
        clock=str(times_path),
    )
