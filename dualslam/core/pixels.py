"""Input and output of a pixel matcher."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualslam.core.types import FloatArray, IntArray


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
