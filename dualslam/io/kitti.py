"""KITTI odometry: ``sequences/NN`` of ``image_0/`` or ``image_2/``, ``calib.txt``, ``times.txt``, ``poses/NN.txt``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dualslam.core.errors import InputError
from dualslam.core.types import FloatArray
from dualslam.io.camera_files import listed_camera
from dualslam.io.images import ImageFiles, list_images
from dualslam.io.sequence import Given, Recording, image_size
from dualslam.io.times import needed_file, recorded_times
from dualslam.io.trajectory_files import Trajectory, numbered_lines, read_kitti

_CAMERAS = (0, 2)


def recognises(folder: Path) -> bool:
    """Tell whether `folder` is a sequence of KITTI odometry."""
    return any((folder / f"image_{c}").is_dir() for c in _CAMERAS)


def open_recording(folder: Path, given: Given) -> Recording:
    """Open a sequence folder; the left grey camera (``image_0``) goes before the left colour one (``image_2``)."""
    number = next(c for c in _CAMERAS if (folder / f"image_{c}").is_dir())
    times_path, calib_path = folder / "times.txt", folder / "calib.txt"
    timestamps_s, paths = recorded_times(times_path, list_images(folder / f"image_{number}"), given.rate_hz)
    images = ImageFiles(paths)
    if not given.camera:
        needed_file(calib_path, "a camera file")
    P = read_projection(calib_path, number) if calib_path.exists() else None
    name, camera = folder.resolve().name, None
    if P is not None and not given.camera:
        # calib.txt does not say the size of the rectified images, which differs between the sequences.
        fxycxy = [P[0, 0], P[1, 1], P[0, 2], P[1, 2]]
        camera = listed_camera(fxycxy, [], image_size(images, name), str(calib_path))
    return Recording(
        name=f"kitti_{name}" if name.isdigit() else name,
        images=images,
        timestamps_s=timestamps_s,
        camera=camera,
        ground_truth=_ground_truth(folder, timestamps_s, P),
        calibration=str(calib_path),
        clock=str(times_path),
    )


def read_projection(path: Path, camera: int) -> FloatArray:
    """Return the (3, 4) projection matrix ``P<camera>`` of a ``calib.txt``."""
    for _, line in numbered_lines(path):
        name, *words = line.replace(":", " ").split() or [""]
        if name == f"P{camera}":
            try:
                P = np.array([float(w) for w in words])
            except ValueError:
                P = np.zeros(0)
            if P.shape != (12,) or not np.isfinite(P).all():
                raise InputError(f"{path}: P{camera} should be 12 finite numbers (a 3 x 4 matrix by rows).")
            return P.reshape(3, 4)
    raise InputError(f"{path} has no line `P{camera}:` with the projection matrix of image_{camera}.")


def _ground_truth(folder: Path, timestamps_s: FloatArray, P: FloatArray | None) -> Trajectory | None:
    path = folder.resolve().parent.parent / "poses" / f"{folder.resolve().name}.txt"
    if not path.exists():
        return None
    T_world_cam0 = read_kitti(path)
    if len(T_world_cam0) != len(timestamps_s):
        raise InputError(f"{path} has {len(T_world_cam0)} poses for {len(timestamps_s)} frames; fetch it again.")
    # The poses are those of camera 0; P = K [I | t] tells where the others stand beside it.
    T_cam0_cam = np.eye(4)
    if P is not None:
        T_cam0_cam[:3, 3] = -np.linalg.solve(P[:, :3], P[:, 3])
    return Trajectory(timestamps_s, T_world_cam0 @ T_cam0_cam)
