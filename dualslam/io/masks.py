"""Masks that come with a sequence: which pixels show no scene, in all frames or in each."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.errors import InputError
from dualslam.core.interfaces import Sequence
from dualslam.core.types import BoolArray
from dualslam.io.images import list_images
from dualslam.io.sequence import ChangedFrames

log = logging.getLogger(__name__)

SCENE = 128
"""Grey level from which on a mask's pixel is scene: lossy files have more than two levels."""
LIKELY = (0.0, 0.7)
"""Share of an image that a mask hides. Outside, it says nothing, or hides what it should show."""
MAX_FACTOR = 16
"""By which a mask may be larger than the frames, which were read smaller."""


def masked(sequence: Sequence, path: str | Path | None) -> Sequence:
    """Return a sequence whose frames have masks; itself without any.

    `path`: an image of the size of the frames, 0 where no scene is. A folder has one for each frame of the source. They
    are named as the frames, or in their order.

    Raises `InputError` if there is no such file, a frame has no mask, or the first mask cannot be used.
    """
    if path is None:
        return sequence
    where = Path(path)
    if where.is_dir():
        paths = _by_frame(sequence, where)
        read_mask(paths[min(paths)], sequence.camera.size_px)
        size_px = sequence.camera.size_px
        return ChangedFrames(sequence, lambda frame: replace(frame, hidden=read_mask(paths[frame.index], size_px)))
    mask = read_mask(where, sequence.camera.size_px)
    if not LIKELY[0] < mask.mean() < LIKELY[1]:
        log.warning("mask %s hides %.0f %% of the image: black is hidden, white is scene", where, 100 * mask.mean())
    return ChangedFrames(sequence, lambda frame: replace(frame, hidden=mask), hidden=mask)


def read_mask(path: Path, size_px: tuple[int, int]) -> BoolArray:
    """Return the pixels (H, W) that a mask hides in images of a size (width, height).

    Raises `InputError` if it cannot be read, is of another size, or hides all.
    """
    width, height = size_px
    if not path.is_file():
        raise InputError(f"mask {path} does not exist; give an image, or a folder with one for each frame.")
    data = np.fromfile(path, np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    if image is None:
        raise InputError(f"mask {path} cannot be read as an image.")
    image = _levels(image)
    factor = next((n for n in range(1, MAX_FACTOR + 1) if (image.shape[1] // n, image.shape[0] // n) == size_px), None)
    if factor is None:
        raise InputError(f"mask {path} is {image.shape[1]} x {image.shape[0]} pixels, the frames {width} x {height}.")
    scene = (image[: height * factor, : width * factor] >= SCENE).astype(np.uint8)
    whole = scene.reshape(height, factor, width, factor).min(axis=(1, 3))
    if not whole.any():
        raise InputError(f"mask {path} is black: it leaves no pixel of the frames; the scene is white.")
    return np.asarray(whole == 0)


def _levels(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Return a mask as (H, W) grey levels: 0 where it is transparent; one of zeros and ones is black and white."""
    grey = image
    if image.ndim == 3:
        grey = image[..., 0] if image.shape[2] == 2 else cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2GRAY)
        if image.shape[2] in (2, 4):
            grey = np.where(image[..., -1] > 0, grey, 0)
    highest = int(grey.max())
    if highest == 1 or highest > 255:
        grey = grey.astype(np.float64) * (255.0 if highest == 1 else 255.0 / 65535.0)
    return np.asarray(grey, np.uint8)


def _by_frame(sequence: Sequence, folder: Path) -> Mapping[int, Path]:
    """Return a mask's path for each frame that is read, by its index."""
    paths, indices = list_images(folder), getattr(sequence, "source_indices", None)
    if indices is None:
        raise InputError(f"masks {folder}: a live source takes one mask for all its frames, an image.")
    names: tuple[str, ...] | None = getattr(sequence, "image_names", None)
    by_name = {path.stem: path for path in paths}
    if names is not None and names and names[int(indices[0])] in by_name:
        found = {index: by_name.get(names[index]) for index in indices.tolist()}
    else:
        found = dict(enumerate(paths))
    for index in indices.tolist():
        if found.get(index) is None:
            named = f" ({names[index]})" if names is not None and index < len(names) else ""
            raise InputError(f"masks {folder}: frame {index}{named} has none; there are {len(paths)} masks.")
    return {index: path for index, path in found.items() if path is not None}


def hidden_pixels(sequence: Sequence, found: BoolArray | None) -> BoolArray | None:
    """Return what is hidden in all frames of a sequence: by its one mask, and as was found; None for nothing."""
    given: BoolArray | None = getattr(sequence, "hidden", None)
    if given is None or found is None:
        return found if given is None else given
    return given | found
