"""The keyframes' images with the lens taken out, and the colours of the points from them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.camera.base import Camera
from dualslam.core.errors import InputError
from dualslam.core.types import FloatArray, Frame
from dualslam.export.colmap import image_name
from dualslam.export.exported_map import ExportedMap
from dualslam.io.atomic import atomic_file

FOLDER = "images"


def with_images(
    exported: ExportedMap, camera: Camera, frames: Iterable[Frame], numbers: Mapping[int, int], out: Path | None
) -> ExportedMap:
    """Return the map with its points' colours, the median of their views, and write the images if a folder is given.

    With a folder, views whose image is not there are left out: those of an earlier run, whose map this one continues.

    Parameters
    ----------
    exported : ExportedMap
    camera : Camera
        As in the saved map: it knows the lens.
    frames : iterable of Frame
        Of the source that the run was made of; those that are no keyframes are passed over.
    numbers : mapping of int to int
        Of the run's frames, as `read_numbers` gives them.
    out : Path, optional
        Images go into ``out/images``.

    Raises
    ------
    InputError
        If a folder is given, and there is no image.
    """
    row_of = exported.rows_by_index(numbers)
    maps: dict[int, tuple[NDArray[np.float32], NDArray[np.float32]]] = {}
    seen = np.zeros((len(exported.view), 3))
    known = np.zeros(len(exported.view), bool)
    has_image = np.zeros(len(exported.frame), bool)
    for frame in frames:
        v = row_of.get(frame.index)
        if v is None or frame.image is None:
            continue
        c = int(exported.camera[v])
        if c not in maps:
            maps[c] = undistortion(camera, exported.K[c], exported.size_px)
        image = cv2.remap(frame.image, *maps[c], cv2.INTER_LINEAR)
        image = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        if out is not None:
            _write(out / FOLDER / image_name(int(exported.frame[v])), image)
        has_image[v] = True
        rows = np.flatnonzero(exported.view == v)
        at = np.rint(exported.uv_px[rows]).astype(int)
        inside = ((at >= 0) & (at < np.array(exported.size_px))).all(axis=1)
        seen[rows[inside]] = image[at[inside, 1], at[inside, 0], ::-1]
        known[rows[inside]] = True
    coloured = replace(exported, colour=_medians(exported, seen, known))
    if out is None:
        return coloured
    if not has_image.any():
        raise InputError("--images has the image of no keyframe: name the source that the run was made of.")
    return coloured.of_views(has_image)


def undistortion(
    camera: Camera, K: FloatArray, size_px: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return for each pixel of the pinhole image K its place in the camera's image: columns and rows, (H, W) each."""
    u, v = np.meshgrid(np.arange(size_px[0], dtype=float), np.arange(size_px[1], dtype=float))
    rays = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], 1) @ np.linalg.inv(K).T
    raw = np.nan_to_num(camera.project(rays), nan=-1e4).astype(np.float32).reshape(*u.shape, 2)
    return np.ascontiguousarray(raw[..., 0]), np.ascontiguousarray(raw[..., 1])


def _write(path: Path, image: NDArray[np.uint8]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as file:
        file.write(cv2.imencode(".png", image)[1].tobytes())


def _medians(exported: ExportedMap, seen: FloatArray, known: NDArray[np.bool_]) -> NDArray[np.uint8]:
    colour = exported.colour.copy()
    rows = np.flatnonzero(known)
    point = exported.point[rows]
    first = np.searchsorted(point, np.arange(len(colour) + 1))
    for p in np.unique(point).tolist():
        colour[p] = np.rint(np.median(seen[rows[first[p] : first[p + 1]]], axis=0)).astype(np.uint8)
    return colour
