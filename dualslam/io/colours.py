"""Colours of a map's landmarks: read from the source's images, and kept beside the map."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.atlas.atlas import Atlas
from dualslam.core.types import Frame, IntArray
from dualslam.io.map_files import load_arrays, save_arrays

COLOURS, PICTURES = "colours.npz", "pictures.npz"
GREY = 128
"""Red, green and blue of a landmark that no colour image shows."""

Colours = Mapping[int, NDArray[np.uint8]]
"""(N, 3) red, green, blue of each landmark, by the submap's id."""


def save_colours(map_folder: Path, colours: Colours) -> None:
    """Write the colours into a map's folder."""
    save_arrays(map_folder / COLOURS, {f"{m:02d}": rgb for m, rgb in colours.items()})


def load_colours(map_folder: Path) -> dict[int, NDArray[np.uint8]]:
    """Return the colours of a map; empty where it was saved without.

    Raises `InputError` if the file is damaged.
    """
    path = map_folder / COLOURS
    if not path.is_file():
        return {}
    return {int(name): np.asarray(rgb, np.uint8).reshape(-1, 3) for name, rgb in load_arrays(path).items()}


def padded(colours: Colours, submap_id: int, n: int) -> NDArray[np.uint8]:
    """Return the colours (n, 3) of a submap's first `n` landmarks, `GREY` beyond those that have one."""
    known = colours.get(submap_id, np.zeros((0, 3), np.uint8))[:n]
    return np.concatenate([known, np.full((n - len(known), 3), GREY, np.uint8)])


def save_pictures(map_folder: Path, pictures: Mapping[int, bytes]) -> None:
    """Write JPEGs, by the index of their frame."""
    arrays = {f"{index:06d}": np.frombuffer(jpeg, np.uint8) for index, jpeg in pictures.items()}
    save_arrays(map_folder / PICTURES, arrays)


def load_pictures(map_folder: Path) -> dict[int, bytes]:
    """Return the pictures of a map; empty where it was saved without.

    Raises `InputError` if the file is damaged.
    """
    path = map_folder / PICTURES
    return {int(name): jpeg.tobytes() for name, jpeg in load_arrays(path).items()} if path.is_file() else {}


def likeness(picture: bytes, image: NDArray[np.uint8]) -> float:
    """Return the correlation of a picture with an image, grey or RGB, in the picture's size.

    It is above 0.98 for the image that the picture was made of. For the next frame of eight recordings it is 0.56 to
    0.97 in the median, for another recording below 0.2.
    """
    small = np.asarray(cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_GRAYSCALE), np.float64)
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    other = np.asarray(cv2.resize(grey, small.shape[::-1], interpolation=cv2.INTER_AREA), np.float64)
    a, b = small - small.mean(), other - other.mean()
    size = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / size if size > 0 else 0.0


def landmark_colours(
    atlas: Atlas, frames: Iterable[Frame], numbers: Mapping[int, int], before: Colours
) -> dict[int, NDArray[np.uint8]]:
    """Return the colour of each landmark: the median over its observations, channel by channel.

    Needs memory for one image at a time and 11 bytes an observation.

    - `frames`: colour images (H, W, 3) of keyframes, or grey ones; others are ignored.
    - `numbers`: the number in the map of each frame, by its index in the source.
    - `before` (mapping of int to (N, 3) uint8): colours of a saved map that the run continued; `GREY` where neither
      knows one.
    """
    colours = {m: padded(before, m, len(submap.landmarks)) for m, submap in atlas.submaps.items()}
    seen: dict[int, list[tuple[IntArray, NDArray[np.uint8]]]] = {m: [] for m in atlas.submaps}
    for frame in frames:
        k = numbers.get(frame.index)
        if k is None or frame.image is None:
            continue
        for m, submap in atlas.submaps.items():
            if k in submap.keyframes:
                rows = np.flatnonzero(submap.landmark_of[k] >= 0)
                uv = submap.keyframes[k].features.uv_px[rows]
                seen[m].append((submap.landmark_of[k][rows], _pixels(frame.image, uv)))
    for m, parts in seen.items():
        if parts:
            landmark, rgb = (np.concatenate(column) for column in zip(*parts, strict=True))
            ids, medians = _medians(landmark, rgb)
            colours[m][ids] = medians
    return colours


def keyframe_indices(atlas: Atlas, numbers: Mapping[int, int]) -> list[int]:
    """Return the frames of a run that are keyframes of any submap, by their index in the source."""
    keyframes = {k for submap in atlas.submaps.values() for k in submap.keyframes}
    return [index for index, number in numbers.items() if number in keyframes]


def _pixels(image: NDArray[np.uint8], uv_px: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return the colours (N, 3) at pixels (N, 2); those outside the image take its border."""
    height, width = image.shape[:2]
    u, v = np.clip(np.rint(uv_px).astype(np.int64), 0, [width - 1, height - 1]).T
    at = image[v, u]
    return at if at.ndim == 2 else np.repeat(at[:, None], 3, axis=1)


def _medians(group: IntArray, values: NDArray[np.uint8]) -> tuple[IntArray, NDArray[np.uint8]]:
    """Return the groups that occur, and the median of each column of their values."""
    ids, first, count = np.unique(np.sort(group), return_index=True, return_counts=True)
    lower, upper = first + (count - 1) // 2, first + count // 2
    ordered = [column[np.lexsort((column, group))].astype(np.float64) for column in values.T]
    return ids, np.stack([np.rint((c[lower] + c[upper]) / 2) for c in ordered], axis=1).astype(np.uint8)
