"""ORB features (Rublee et al. 2011) on our own pyramid, with well-spread corners and sub-pixel positions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dualslam.core.config import StrictModel
from dualslam.core.errors import InputError
from dualslam.core.types import Features, FloatArray, IntArray, Matches
from frontends.corners import detect_corners, refine_corners, select_spread, share_out
from frontends.registry import parse_options

PATCH_RADIUS_PX = 15
"""Radius of the disc whose intensity centroid gives the orientation, in pixels of the level (ORB, section 3.2)."""
MARGIN_PX = PATCH_RADIUS_PX + 1
"""Rim of each level without corners, so that the orientation sees nothing beyond the image."""


class OrbOptions(StrictModel):
    """`frontend.options` of the ORB front end."""

    scale_factor: float = Field(1.2, gt=1.0, le=2.0)
    """Ratio of the sizes of neighbouring pyramid levels."""
    n_octaves: int = Field(8, ge=1, le=16)
    """Number of pyramid levels."""
    fast_thresholds: tuple[int, ...] = Field((20, 7), min_length=1)
    """FAST contrasts in grey levels, descending: the first everywhere, the next only in cells without a corner yet."""
    cell_px: int = Field(32, ge=8)
    """Side of these cells, pixels of the level."""
    refine: bool = True
    """Sub-pixel corner positions."""
    ratio: float = Field(0.85, gt=0.0, le=1.0)
    """`match_wide`: greatest distance of the best match over that of the second best."""


class OrbFrontend:
    """FAST corners, intensity-centroid orientation, rotated BRIEF descriptors of 256 bits."""

    name = "orb"

    def __init__(self, n_features: int = 1500, options: OrbOptions | None = None) -> None:
        self.options = options or OrbOptions()
        self.n_features = n_features
        self.scale_factor = self.options.scale_factor
        self.n_octaves = self.options.n_octaves
        self.max_distance = 90.0
        self.max_distance_strict = 50.0
        # One level, no border filter: the pyramid and the rim are ours.
        self._descriptor = cv2.ORB.create(nfeatures=1, nlevels=1, edgeThreshold=0, patchSize=31)
        self._moments = _moment_weights()

    @classmethod
    def from_options(cls, n_features: int, options: Mapping[str, Any]) -> OrbFrontend:
        return cls(n_features, parse_options(OrbOptions, cls.name, options))

    def extract(self, image: NDArray[np.uint8]) -> Features:
        levels = self._pyramid(_to_grey(image))
        corners = [
            detect_corners(level, self.options.fast_thresholds, MARGIN_PX, self.options.cell_px) for level in levels
        ]
        weights = self.scale_factor ** -np.arange(len(levels), dtype=np.float64)
        quotas = share_out([len(xy) for xy, _ in corners], weights, self.n_features)
        parts = [
            self._describe(level, octave, levels[0].shape, xy[select_spread(xy, response, quota)])
            for octave, (level, (xy, response), quota) in enumerate(zip(levels, corners, quotas, strict=True))
        ]
        uv, octave, angle, descriptors = (np.concatenate(column) for column in zip(*parts, strict=True))
        scale = self.scale_factor ** octave.astype(np.float64)
        return Features(uv, uv, scale.copy(), scale, octave, angle, descriptors)

    def _pyramid(self, grey):
        levels = [grey]
        height, width = grey.shape
        for octave in range(1, self.n_octaves):
            size = (round(width / self.scale_factor**octave), round(height / self.scale_factor**octave))
            if min(size) <= 2 * MARGIN_PX:
                break
            levels.append(cv2.resize(levels[-1], size, interpolation=cv2.INTER_LINEAR))
        return levels

    def _describe(self, level, octave, base_shape, xy):
        if len(xy) == 0:
            return np.empty((0, 2)), np.empty(0, np.int64), np.empty(0), np.empty((0, 32), np.uint8)
        side = 2 * PATCH_RADIUS_PX + 1
        windows = np.lib.stride_tricks.sliding_window_view(level, (side, side))
        patches = windows[xy[:, 1] - PATCH_RADIUS_PX, xy[:, 0] - PATCH_RADIUS_PX]
        moments = patches.reshape(len(patches), side * side).astype(np.float32) @ self._moments
        angle = np.arctan2(moments[:, 1], moments[:, 0]).astype(np.float64)
        degrees = np.degrees(angle) % 360.0
        keypoints = [
            cv2.KeyPoint(x, y, side, a) for (x, y), a in zip(xy.tolist(), degrees.tolist(), strict=True)
        ]
        kept, descriptors = self._descriptor.compute(level, keypoints)
        assert len(kept) == len(xy)
        on_level = xy + refine_corners(patches)[0] if self.options.refine else xy.astype(np.float64)
        ratio = np.array([base_shape[1] / level.shape[1], base_shape[0] / level.shape[0]])
        return (on_level + 0.5) * ratio - 0.5, np.full(len(xy), octave), angle, descriptors

    def distance(self, a, b):
        words_a, words_b = (np.ascontiguousarray(each).view(np.uint64) for each in (a, b))
        return np.bitwise_count(words_a ^ words_b).sum(axis=-1, dtype=np.float64)


def _to_grey(image):
    if image.ndim == 3:
        return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.ascontiguousarray(image)


def _moment_weights():
    r = PATCH_RADIUS_PX
    v, u = np.mgrid[-r : r + 1, -r : r + 1].astype(np.float32)
    disc = u**2 + v**2 <= (r + 0.5) ** 2
    return np.stack([u * disc, v * disc], axis=-1).reshape(-1, 2)
