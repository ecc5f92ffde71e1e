"""COLMAP's text format (colmap.github.io/format.html): input of its tools and of trainers of Gaussian splats.

COLMAP counts pixels from the corner of the image: the centre of the first one is (0.5, 0.5), ours (0, 0).
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from dualslam.core.geometry import se3, so3
from dualslam.io.atomic import write_text
from dualslam.io.export.exported_map import ExportedMap

FOLDER = Path("sparse") / "0"
CORNER_PX = 0.5
DECIMALS = 15
"""As many as a number of about 1 has: what is left of a 0 after some turns, such as 4.9e-19, is written as 0."""


def image_name(frame: int) -> str:
    """Return the name of a keyframe's image."""
    return f"{frame:06d}.png"


def mask_path(image: str) -> Path:
    """Return where the mask of an image is, in the export's folder: as COLMAP names it."""
    return Path("masks") / f"{image}.png"


def write_colmap(exported: ExportedMap, out: Path) -> None:
    """Write ``sparse/0/cameras.txt``, ``images.txt`` and ``points3D.txt`` into a folder."""
    folder = out / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "cameras.txt", _cameras(exported))
    # A point's track names observations by their place in the image's list.
    place = np.zeros(len(exported.view), np.int64)
    by_view = np.argsort(exported.view, kind="stable")
    first = np.searchsorted(exported.view[by_view], np.arange(len(exported.frame) + 1))
    place[by_view] = np.arange(len(by_view)) - first[exported.view[by_view]]
    write_text(folder / "images.txt", _images(exported, by_view, first))
    write_text(folder / "points3D.txt", _points(exported, place))


def _cameras(exported: ExportedMap) -> str:
    width, height = exported.size_px
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, fx, fy, cx, cy"]
    for c, K in enumerate(exported.K):
        numbers = (K[0, 0], K[1, 1], K[0, 2] + CORNER_PX, K[1, 2] + CORNER_PX)
        lines.append(f"{c + 1} PINHOLE {width} {height} {decimals(numbers)}")
    return "\n".join(lines) + "\n"


def _images(exported: ExportedMap, by_view: np.ndarray, first: np.ndarray) -> str:
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# X, Y, POINT3D_ID of each observation"]
    T_cam_world = se3.inverse(exported.T_world_cam)
    quat = so3.quat_xyzw_from_matrix(T_cam_world[:, :3, :3])[:, [3, 0, 1, 2]]
    for v, frame in enumerate(exported.frame.tolist()):
        pose = decimals((*quat[v], *T_cam_world[v, :3, 3]))
        lines.append(f"{v + 1} {pose} {exported.camera[v] + 1} {image_name(frame)}")
        rows = by_view[first[v] : first[v + 1]]
        uv = exported.uv_px[rows] + CORNER_PX
        points = (exported.point[rows] + 1).tolist()
        lines.append(" ".join(f"{decimals(at)} {p}" for at, p in zip(uv.tolist(), points, strict=True)))
    return "\n".join(lines) + "\n"


def _points(exported: ExportedMap, place: np.ndarray) -> str:
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    n = len(exported.xyz)
    errors = exported.reprojection_errors_px()
    n_views = np.bincount(exported.point, minlength=n)
    mean = np.bincount(exported.point, np.nan_to_num(errors), n) / np.maximum(n_views, 1)
    first = np.searchsorted(exported.point, np.arange(n + 1))
    views, places = (exported.view + 1).tolist(), place.tolist()
    for p in range(n):
        track = " ".join(f"{views[r]} {places[r]}" for r in range(first[p], first[p + 1]))
        colour = " ".join(str(c) for c in exported.colour[p].tolist())
        lines.append(f"{p + 1} {decimals(exported.xyz[p])} {colour} {decimals(mean[p : p + 1])} {track}")
    return "\n".join(lines) + "\n"


def decimals(numbers: Iterable[float]) -> str:
    """Return numbers with a space between them, as short as they read back the same, and never with an exponent."""
    return " ".join(np.format_float_positional(round(float(x), DECIMALS) + 0.0, trim="-") for x in numbers)
