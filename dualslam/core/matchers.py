"""What matchers of pixels, and of places, take and return."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dualslam.core.types import Features, FloatArray, IntArray

if TYPE_CHECKING:
    from dualslam.map.submap import Submap

CELLS = 4
"""Parts of an image along either axis."""
MIN_IN_CELL = 5
"""Landmarks that a part must be expected to show to have a say."""


@dataclass(frozen=True, slots=True, eq=False)
class PosedImage:
    """An image with a known pose, and N landmarks in it."""

    index: int  # of its frame
    image: NDArray[np.uint8]  # (H, W)
    T_cam_submap: FloatArray  # (4, 4)
    landmark_ids: IntArray  # (N,)
    uv_px: FloatArray  # (N, 2): where the image shows the landmarks: pixels as read, with the lens in them
    depth_mu: FloatArray  # (N,): of the landmarks in this camera, along its axis


@dataclass(frozen=True, slots=True, eq=False)
class PixelMatches:
    """M landmarks in a new image: ids, pixels (M, 2) as read, and the standard deviation (M,) of each coordinate."""

    landmark_ids: IntArray
    uv_px: FloatArray
    sigma_px: FloatArray

    @classmethod
    def none(cls) -> PixelMatches:
        """Return no matches."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0))

    def __len__(self) -> int:
        return len(self.landmark_ids)


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """Which landmarks a camera should see, and where they are found."""

    landmark_ids: IntArray
    """(V,): in the image, in front of the camera, and from a like side and distance as they were seen from."""
    feature: IntArray  # (V,): the feature that each is found at, or -1
    cell: IntArray  # (V,): the part of the image, of `CELLS` x `CELLS`, in which it should be seen

    @property
    def share(self) -> float:
        """Share of what should be seen that is found, in the middle one of the image's parts; 0 where nothing should.

        A thing in two places (a poster) fills some parts, and nothing is found in the others. A place seen from
        elsewhere, or in other light, shows less of itself everywhere.
        """
        n = np.bincount(self.cell, minlength=CELLS * CELLS)
        found = np.bincount(self.cell[self.feature >= 0], minlength=CELLS * CELLS)
        counts = n >= MIN_IN_CELL
        return float(np.median(found[counts] / n[counts])) if counts.any() else 0.0


Look = Callable[["Submap", IntArray, FloatArray, FloatArray, Features, float], Sighting]
"""Looks for landmarks of a submap in an image, about where they should be: their ids, the pose ``T_cam_submap``, the
image's intrinsics (3, 3), its features, and the radius in pixels at the finest octave."""
