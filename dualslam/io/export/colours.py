"""Colours of landmarks, from the keyframes' images in the source of a run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from dualslam.atlas.atlas import Atlas
from dualslam.core.types import Frame, IntArray
from dualslam.io.colours import Colours, padded


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
