"""TUM RGB-D: ``rgb.txt`` lists times and colour images, ``groundtruth.txt`` has the motion capture's own times."""

from __future__ import annotations

import re
from pathlib import Path

from dualslam.core.camera.base import Camera
from dualslam.core.errors import InputError
from dualslam.io.camera_files import listed_camera
from dualslam.io.images import ImageFiles
from dualslam.io.sequence import Given, Recording
from dualslam.io.times import checked_times
from dualslam.io.trajectory_files import numbered_lines, read_tum

# fx fy cx cy k1 k2 p1 p2 k3 of the colour cameras, 640 x 480, as the benchmark publishes them.
INTRINSICS = {
    1: [517.306408, 516.469215, 318.643040, 255.313989, 0.262383, -0.953104, -0.005358, 0.002628, 1.163314],
    2: [520.908620, 521.007327, 325.141442, 249.701764, 0.231222, -0.784899, -0.003257, -0.000105, 0.917205],
    3: [535.4, 539.2, 320.1, 247.6],
}


def recognises(folder: Path) -> bool:
    """Tell whether `folder` is a sequence of TUM RGB-D."""
    return (folder / "rgb.txt").is_file()


def open_recording(folder: Path, given: Given) -> Recording:
    """Open a sequence folder; the camera is known by ``fr1``, ``fr2`` or ``fr3`` in its name."""
    listing = folder / "rgb.txt"
    times, paths = [], []
    for number, line in numbered_lines(listing):
        try:
            time, name = line.split()
            times.append(float(time))
        except ValueError:
            raise InputError(f"{listing}, line {number}: {line[:60]!r} is not `timestamp filename`.") from None
        paths.append(folder / name)
    if not paths:
        raise InputError(f"{listing} lists no images; each line should be `timestamp filename`.")
    truth_path = folder / "groundtruth.txt"
    return Recording(
        name=folder.resolve().name,
        images=ImageFiles(paths),
        timestamps_s=checked_times(times, str(listing)),
        camera=None if given.camera else _camera(folder),
        ground_truth=read_tum(truth_path) if truth_path.exists() else None,
        calibration="the benchmark's calibration",
        clock=str(listing),
    )


def _camera(folder: Path) -> Camera:
    name = folder.resolve().name
    found = re.search(r"(?:fr|freiburg)_?([123])", name.lower())
    if found is None:
        raise InputError(
            f"{folder}: the camera of a TUM RGB-D sequence follows from fr1, fr2 or fr3 in its folder's name. "
            "This name has none; give a camera file."
        )
    numbers = INTRINSICS[int(found.group(1))]
    return listed_camera(numbers[:4], numbers[4:], (640, 480), f"fr{found.group(1)}")
