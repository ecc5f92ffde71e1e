"""EuRoC's ASL layout: ``mav0/cam0`` with ``data.csv`` and ``sensor.yaml``, ``mav0/state_groundtruth_estimate0``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dualslam.core.errors import InputError
from dualslam.core.geometry.se3 import from_parts
from dualslam.core.geometry.so3 import matrix_from_quat_xyzw
from dualslam.core.types import FloatArray
from dualslam.io.camera_keys import camera_of_mapping
from dualslam.io.camera_text import parse_yaml
from dualslam.io.images import ImageFiles
from dualslam.io.sequence import Given, Recording
from dualslam.io.times import checked_times, needed_file
from dualslam.io.trajectory_files import Trajectory, numbered_lines, read_text


def recognises(folder: Path) -> bool:
    """Tell whether `folder` is a sequence of EuRoC, or its ``mav0``."""
    return _mav0(folder) is not None


def open_recording(folder: Path, given: Given) -> Recording:
    """Open a sequence folder: the left camera, and the ground truth carried over from the body to the camera."""
    mav0 = _mav0(folder)
    if mav0 is None:
        raise InputError(f"{folder} has no mav0/cam0/data.csv; give the folder that holds mav0.")
    listing = mav0 / "cam0" / "data.csv"
    times, paths = _read_listing(listing)
    sensor_path = mav0 / "cam0" / "sensor.yaml"
    truth_path = mav0 / "state_groundtruth_estimate0" / "data.csv"
    sensor: dict[str, Any] = {}
    if sensor_path.exists() or not given.camera:
        sensor = parse_yaml(needed_file(sensor_path, "a camera file"), read_text(sensor_path))
    truth = None
    if truth_path.exists() and sensor:
        truth = _read_truth(truth_path, body_from_camera(sensor, sensor_path))
    return Recording(
        name=mav0.resolve().parent.name,
        images=ImageFiles(paths),
        timestamps_s=checked_times(times, str(listing)),
        camera=None if given.camera else camera_of_mapping(sensor, str(sensor_path)),
        ground_truth=truth,
        calibration=str(sensor_path),
        clock=str(listing),
    )


def _mav0(folder: Path) -> Path | None:
    for candidate in (folder / "mav0", folder):
        if (candidate / "cam0" / "data.csv").is_file():
            return candidate
    return None


def _read_listing(listing: Path) -> tuple[FloatArray, list[Path]]:
    times, paths = [], []
    for number, line in numbered_lines(listing):
        words = [word.strip() for word in line.split(",")]
        if len(words) != 2 or not words[0].isdigit():
            raise InputError(f"{listing}, line {number}: {line[:60]!r} is not `timestamp in nanoseconds,filename`.")
        times.append(_seconds(words[0]))
        paths.append(listing.parent / "data" / words[1])
    if not paths:
        raise InputError(f"{listing} lists no images; each line should be `timestamp in nanoseconds,filename`.")
    return np.array(times), paths


def _seconds(nanoseconds: str) -> float:
    # Whole numbers first: the nanoseconds of an epoch time do not fit a float, its seconds fit to 0.2 microseconds.
    seconds, rest = divmod(int(nanoseconds), 10**9)
    return seconds + rest * 1e-9


def body_from_camera(sensor: dict[str, Any], where: Path) -> FloatArray:
    """Return ``T_body_cam``, which the file calls T_BS."""
    value = sensor.get("T_BS")
    data = value.get("data") if isinstance(value, dict) else value
    try:
        T_body_cam = np.asarray(data, float).reshape(4, 4)
    except (TypeError, ValueError):
        raise InputError(f"{where}: T_BS is not a matrix of 4 x 4 numbers.") from None
    if not np.isfinite(T_body_cam).all():
        raise InputError(f"{where}: T_BS holds a number that is not finite.")
    return T_body_cam


def _read_truth(path: Path, T_body_cam: FloatArray) -> Trajectory:
    """Read ``timestamp [ns], p (3), q w x y z, ...`` of the body and return the camera's poses."""
    times, rows = [], []
    for number, line in numbered_lines(path):
        words = line.replace(",", " ").split()
        try:
            times.append(_seconds(words[0]))
            rows.append([float(word) for word in words[1:8]])
        except (ValueError, IndexError):
            raise InputError(f"{path}, line {number}: {line[:60]!r} is not a line of the ground truth.") from None
        if len(rows[-1]) != 7:
            raise InputError(f"{path}, line {number}: {len(words)} fields; timestamp, position and quaternion are due.")
    table = np.array(rows).reshape(-1, 7)
    if len(table) == 0 or not np.isfinite(table).all():
        raise InputError(f"{path} is empty or holds a value that is not finite; fetch it again.")
    T_world_body = from_parts(matrix_from_quat_xyzw(table[:, [4, 5, 6, 3]]), table[:, :3])
    return Trajectory(checked_times(times, str(path)), T_world_body @ T_body_cam)
