"""Colours of a map's landmarks, and small pictures of what it was made from: two files beside the map's arrays."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

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
