"""A small front end for video without turns: Shi-Tomasi corners, described by the greys about them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dualslam.core.config.settings import StrictModel
from dualslam.core.errors import InputError
from dualslam.core.types import Features, Matches
from dualslam.frontends.registry import parse_options

REACH_PX = 14
SAMPLES = np.linspace(-REACH_PX, REACH_PX, 8)


class PatchOptions(StrictModel):
    """`frontend.options` of this front end."""

    quality: float = Field(0.005, gt=0.0, lt=1.0)
    """Least corner strength, as a share of the strongest's."""
    sigma_px: float = Field(0.4, gt=0.0)
    """Noise of a corner's position."""


class PatchFrontend:
    """Implements `dualslam.core.interfaces.Frontend`."""

    name = "patches"
    scale_factor = 1.25  # one octave, which bears this change of size
    n_octaves = 1
    max_distance = 0.9  # unit vectors of greys: a correlation of 0.6
    max_distance_strict = 0.7
    max_turn_deg = 10.0
    max_zoom = 1.1

    def __init__(self, n_features: int = 1000, options: PatchOptions | None = None) -> None:
        self.n_features = n_features
        self.options = options or PatchOptions()

    @classmethod
    def from_options(cls, n_features: int, options: Mapping[str, Any]) -> PatchFrontend:
        """Build from the config."""
        return cls(n_features, parse_options(PatchOptions, cls.name, options))

    def extract(self, image: NDArray[np.uint8]) -> Features:
        """Find corners and describe them."""
        if image.dtype != np.uint8 or image.size == 0 or image.shape[2:] not in ((), (3,)):
            raise InputError(f"an image must be (H, W) or (H, W, 3) uint8, not {image.shape} {image.dtype}")
        grey = np.ascontiguousarray(image if image.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(image), 7))
        uv = self._corners(grey)
        n = len(uv)
        zeros, ones = np.zeros(n), np.ones(n)
        return Features(uv, uv, self.options.sigma_px * ones, ones, np.zeros(n, np.int64), zeros, _patches(grey, uv))

    def distance(self, a: NDArray[np.generic], b: NDArray[np.generic]) -> NDArray[np.float64]:
        """Euclidean distance of unit vectors."""
        return np.linalg.norm(a.astype(np.float64) - b.astype(np.float64), axis=1)

    def match_wide(self, a: Features, b: Features) -> Matches:
        """Mutually nearest, clearly so."""
        if len(a) == 0 or len(b) < 2:
            return Matches(np.empty((0, 2), np.int64), np.empty(0))
        distance = np.sqrt(np.maximum(2.0 - 2.0 * a.descriptors @ b.descriptors.T, 0.0))
        rows, nearest = np.arange(len(a)), distance.argmin(axis=1)
        best, second = np.partition(distance, 1, axis=1)[:, :2].T
        kept = (distance.argmin(axis=0)[nearest] == rows) & (best < 0.8 * second) & (best < self.max_distance_strict)
        index = np.stack([rows, nearest], axis=1)[kept]
        return Matches(index, self.distance(a.descriptors[index[:, 0]], b.descriptors[index[:, 1]]))

    def _corners(self, grey: NDArray[np.uint8]) -> NDArray[np.float64]:
        """Corners (N, 2) whose patch is inside, the strongest first."""
        if min(grey.shape) <= 2 * REACH_PX + 2:
            return np.empty((0, 2))
        mask = np.zeros_like(grey)
        mask[REACH_PX + 1 : -REACH_PX - 1, REACH_PX + 1 : -REACH_PX - 1] = 255
        found = cv2.goodFeaturesToTrack(grey, self.n_features, self.options.quality, 5, mask=mask)
        if found is None:
            return np.empty((0, 2))
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 20, 0.01)
        uv = cv2.cornerSubPix(grey, found.reshape(-1, 1, 2), (3, 3), (-1, -1), criteria).reshape(-1, 2)
        return np.unique(uv.astype(np.float64), axis=0)


def _patches(grey: NDArray[np.uint8], uv_px: NDArray[np.float64]) -> NDArray[np.float32]:
    """8 x 8 blurred greys about each corner, without mean and of length 1, (N, 64) float32."""
    if len(uv_px) == 0:
        return np.empty((0, 64), np.float32)
    smooth = cv2.GaussianBlur(grey, (0, 0), 2.0).astype(np.float32)
    step_v, step_u = (each.ravel() for each in np.meshgrid(SAMPLES, SAMPLES, indexing="ij"))
    map_u, map_v = uv_px[:, :1] + step_u, uv_px[:, 1:] + step_v
    sampled = cv2.remap(smooth, map_u.astype(np.float32), map_v.astype(np.float32), cv2.INTER_LINEAR)
    sampled -= sampled.mean(axis=1, keepdims=True)
    return np.asarray(sampled / np.maximum(np.linalg.norm(sampled, axis=1, keepdims=True), 1e-6), np.float32)
