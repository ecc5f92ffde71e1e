"""The views' images with the lens taken out, and their masks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.camera.base import Camera
from dualslam.core.errors import InputError
from dualslam.core.types import FloatArray, Frame
from dualslam.io.atomic import write_bytes
from dualslam.io.export.colmap import image_name, mask_path
from dualslam.io.export.exported_map import ExportedMap

FOLDER, MASK = "images", "mask.png"


def with_images(
    exported: ExportedMap,
    camera: Camera,
    frames: Iterable[Frame],
    numbers: Mapping[int, int],
    out: Path,
    mask: NDArray[np.uint8] | None = None,
) -> ExportedMap:
    """Write the views' images without the lens, and return the map without the views that have no image.

    An image gets a mask (0 is ignored) where pixels are outside the camera's image, or 0 in `mask`. One image is in
    memory at a time.

    - `camera`: as in the saved map: it knows the lens.
    - `frames`: RGB, of the source that the run was made of; those that are no views are ignored.
    - `numbers`: of the run's frames, as `read_numbers` gives them.
    - `out`: images go into ``out/images``, masks into ``out/masks``.
    - `mask` (H, W) uint8: 0 where the camera's images show nothing of the scene.

    Raises `InputError` if there is no image.
    """
    has_image = np.zeros(len(exported.frame), bool)
    for v, image, valid in undistorted(exported, camera, frames, numbers, mask):
        name = image_name(int(exported.frame[v]))
        _write(out / FOLDER / name, image)
        if not valid.all():
            _write(out / mask_path(name), valid)
        has_image[v] = True
    if not has_image.any():
        raise InputError("--images has the image of no keyframe: name the source that the run was made of.")
    return exported.of_views(has_image)


def undistorted(
    exported: ExportedMap,
    camera: Camera,
    frames: Iterable[Frame],
    numbers: Mapping[int, int],
    mask: NDArray[np.uint8] | None = None,
) -> Iterator[tuple[int, NDArray[np.uint8], NDArray[np.uint8]]]:
    """Yield, as `with_images` has them, the row of each view with an image, that without the lens, and its mask."""
    row_of = exported.rows_by_index(numbers)
    maps: dict[int, tuple[NDArray[np.float32], NDArray[np.float32]]] = {}
    valid: dict[int, NDArray[np.uint8]] = {}
    whole = np.full(exported.size_px[::-1], 255, np.uint8) if mask is None else mask
    for frame in frames:
        v = row_of.get(frame.index)
        if v is None or frame.image is None:
            continue
        c = int(exported.camera[v])
        if c not in maps:
            maps[c] = undistortion(camera, exported.K[c], exported.size_px)
            valid[c] = np.asarray(cv2.remap(whole, *maps[c], cv2.INTER_NEAREST), np.uint8)
        yield v, np.asarray(cv2.remap(frame.image, *maps[c], cv2.INTER_LINEAR), np.uint8), valid[c]


def mask_of(run: Path) -> NDArray[np.uint8] | None:
    """Return a run's mask (H, W), 0 where its images show nothing of the scene; None where it has none."""
    path = run / MASK
    return None if not path.is_file() else np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)


def undistortion(
    camera: Camera, K: FloatArray, size_px: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return for each pixel of the pinhole image K its place in the camera's image: columns and rows, (H, W) each."""
    u, v = np.meshgrid(np.arange(size_px[0], dtype=float), np.arange(size_px[1], dtype=float))
    rays = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], 1) @ np.linalg.inv(K).T
    raw = np.nan_to_num(camera.project(rays), nan=-1e4).astype(np.float32).reshape(*u.shape, 2)
    return np.ascontiguousarray(raw[..., 0]), np.ascontiguousarray(raw[..., 1])


def _write(path: Path, image: NDArray[np.uint8]) -> None:
    """Write a grey or an RGB image; OpenCV encodes BGR."""
    encoded = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image)[1]
    write_bytes(path, encoded.tobytes())
