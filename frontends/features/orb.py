"""ORB features (Rublee et al. 2011) on our own pyramid, with well-spread corners and sub-pixel positions.

The defaults of noise and distances were measured on pairs of KITTI and 7-Scenes:
`docs/notes/2026-11-28-noise-and-distances-of-orb-and-sift.md`.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import repeat
from math import ceil
from typing import Annotated

import cv2
import faiss
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from pydantic import Field

from dualslam.core.config.settings import StrictModel
from dualslam.core.types import Features, FloatArray, IntArray, Matches
from dualslam.frontends.features.corners import (
    detect_corners,
    find_peaks,
    refine_corners,
    select_spread,
    share_out,
    stand_out,
)
from dualslam.frontends.features.groups import NO_MATCHES, consistent_rotation, mutual, nearest_by_parts
from dualslam.frontends.features.images import estimate_noise, noise_of_levels, to_grey
from dualslam.frontends.registry import N_FEATURES, OptionedFrontend

PATCH_RADIUS_PX = 15
"""Radius of the disc whose intensity centroid gives the orientation, in pixels of the level (ORB, section 3.2)."""
DESCRIPTOR_BYTES = 32
PATCH_SIDE_PX = 2 * PATCH_RADIUS_PX + 1
PATCHES_AT_ONCE = 128
"""Of which moments are taken: as numbers of four bytes, more would not fit into a core's cache."""
MARGIN_PX = PATCH_RADIUS_PX + 1
"""Rim of each level without corners, so that the orientation sees nothing beyond the image."""
NOISE_CONTRAST = 5.0
"""Contrast of a corner, relative to the noise, that noise does not make (see the note)."""
SHARP_SHARE = 2 / 3
"""Share of its corners that a sharp image places. At least 76 % in the frames of four recordings (median 94 to 96 %).
53 % in KITTI's under a blur of 4 px, a tenth in those of rendered streets under one of 5 px."""
MAX_THRESHOLD = 254
"""FAST takes no higher one."""


def hamming_distance(a: NDArray[np.generic], b: NDArray[np.generic]) -> FloatArray:
    """Differing bits of paired descriptors (N, 8 k) uint8, (N, 8 k) uint8 -> (N,) float64."""
    words_a, words_b = (np.ascontiguousarray(each).view(np.uint64) for each in (a, b))
    different = np.bitwise_count(words_a ^ words_b).astype(np.uint16)
    # Word by word: numpy's sum along rows of four takes four times as long.
    total = np.zeros(len(different), np.uint16)
    for word in different.T:
        total += word
    return total.astype(np.float64)


def hamming_matrix(a: NDArray[np.generic], b: NDArray[np.generic]) -> NDArray[np.int32]:
    """Differing bits of all pairs of descriptors (N, 8 k) uint8, (M, 8 k) uint8 -> (N, M).

    FAISS takes a quarter of numpy's time, and a twelfth of OpenCV's matcher's.
    """
    a, b = np.ascontiguousarray(a), np.ascontiguousarray(b)
    distances = np.empty((len(a), len(b)), np.int32)
    faiss.hammings(  # type: ignore[attr-defined]  # left out of its stubs
        faiss.swig_ptr(a), faiss.swig_ptr(b), len(a), len(b), a.shape[1], faiss.swig_ptr(distances)
    )
    return distances


Corners = tuple[IntArray, FloatArray]
"""Of one level: pixels (N, 2) and FAST scores (N,)."""


class OrbOptions(StrictModel):
    """`frontend.options` of the ORB front end."""

    scale_factor: float = Field(1.2, gt=1.0, le=2.0)
    """Ratio of the sizes of neighbouring pyramid levels."""
    n_octaves: int = Field(8, ge=1, le=16)
    """Number of pyramid levels."""
    fast_thresholds: tuple[Annotated[int, Field(ge=1, le=254)], ...] = Field((20, 7), min_length=1)
    """FAST contrasts in grey levels, descending: the first everywhere, the next only in cells without a corner yet."""
    fast_threshold_last: int = Field(4, ge=1, le=254)
    """One more, for images that give fewer corners than asked for: up to 1.7 times the inliers under heavy blur. (None
    of the thresholds is ever within the image's noise.)"""
    cell_px: int = Field(32, ge=8)
    """Side of these cells, pixels of the level."""
    sigma_px: float = Field(0.45, gt=0.0)
    """Noise of a position in pixels of its octave, where the sub-pixel step found an extremum (see the note)."""
    sigma_unrefined_px: float = Field(0.65, gt=0.0)
    """The same for the others, about one in ten, which stay at a whole pixel."""
    sigma_unplaced_px: float = Field(1.5, gt=0.0)
    """The same where it is the image's noise that places the corner, along an edge (see the note)."""
    max_distance: float = Field(80.0, gt=0.0, le=256.0)
    """Differing bits up to which a guided match is believed (see the note)."""
    max_distance_strict: float = Field(50.0, gt=0.0, le=256.0)
    """The same without a guide."""
    ratio: float = Field(0.85, gt=0.0, le=1.0)
    """`match_wide`: greatest distance of the best match over that of the second best."""


class OrbFrontend(OptionedFrontend):
    """FAST corners, intensity-centroid orientation, rotated BRIEF descriptors of 256 bits. Implements `Frontend`."""

    name = "orb"
    options: OrbOptions
    options_model = OrbOptions
    max_turn_deg: float = 180.0
    max_zoom: float = 1.7

    def __init__(self, n_features: int = N_FEATURES, options: OrbOptions | None = None) -> None:
        super().__init__(n_features, options)
        self.scale_factor = self.options.scale_factor
        self.n_octaves = self.options.n_octaves
        self.max_distance = self.options.max_distance
        self.max_distance_strict = self.options.max_distance_strict
        self._moments = _moment_weights()

    def extract(self, image: NDArray[np.uint8]) -> Features:
        """Detect and describe up to `n_features` corners, as `Frontend.extract` says, the finest octave first."""
        levels = self._pyramid(to_grey(image))
        noise = noise_of_levels(estimate_noise(levels[0]), len(levels), self.scale_factor)
        corners = self._corners(levels, noise)
        chosen, octave, patches = self._spread(levels, corners)
        peaks = find_peaks(patches)
        placed = stand_out(peaks, noise[octave])
        if placed.sum() < SHARP_SHARE * len(placed):
            chosen, octave, patches = self._spread(levels, _placed(levels, corners, noise))
            peaks = find_peaks(patches)
            placed = np.ones(len(patches), np.bool_)
        angle = self._angles(patches)
        offset, found = refine_corners(peaks)
        descriptors = self._descriptors(levels, chosen, angle)
        # INTER_LINEAR keeps the outer edges of the image in place, so pixel edges scale, not centres. The ratio is of
        # the true sizes, which are rounded.
        ratio = np.array([[image.shape[1] / level.shape[1], image.shape[0] / level.shape[0]] for level in levels])
        uv = (np.concatenate(chosen) + offset + 0.5) * ratio[octave] - 0.5
        scale = self.scale_factor ** octave.astype(np.float64)
        sigma_px = np.where(found, self.options.sigma_px, self.options.sigma_unrefined_px)
        sigma = scale * np.where(placed, sigma_px, self.options.sigma_unplaced_px)
        return Features(uv, uv, sigma, scale, octave, angle, descriptors)

    def distance(self, a: NDArray[np.generic], b: NDArray[np.generic]) -> FloatArray:
        """Hamming distance of paired descriptors (N, 32), (N, 32) uint8 -> (N,) float64, 0 to 256."""
        return hamming_distance(a, b)

    def distances(self, a: NDArray[np.generic], b: NDArray[np.generic]) -> FloatArray:
        """`distance` of all pairs (N, 32), (M, 32) -> (N, M)."""
        return hamming_matrix(a, b).astype(np.float64)

    def match_wide(self, a: Features, b: Features) -> Matches:
        """Compare all with all: mutually nearest, clearly so, within `max_distance_strict`, turned alike."""
        in_a, in_b = a.descriptors, b.descriptors
        if not len(in_a) or not len(in_b):
            return NO_MATCHES
        found = mutual(
            nearest_by_parts(len(in_a), lambda rows: hamming_matrix(in_a[rows], in_b)),
            self.options.ratio,
            self.max_distance_strict,
            lambda columns: hamming_matrix(in_b[columns], in_a).argmin(axis=1),
        )
        kept = consistent_rotation(b.angle_rad[found.index[:, 1]] - a.angle_rad[found.index[:, 0]])
        return Matches(found.index[kept], found.distance[kept])

    def nearest(self, a: Features, b: Features) -> IntArray:
        """Row in b of the feature nearest to each of a, (N,), the first of equals."""
        return np.asarray(hamming_matrix(a.descriptors, b.descriptors).argmin(axis=1), np.int64)

    def _pyramid(self, grey: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
        """Levels from the image itself down to the last that is wider than two rims."""
        levels = [grey]
        height, width = grey.shape
        for octave in range(1, self.n_octaves):
            size = (round(width / self.scale_factor**octave), round(height / self.scale_factor**octave))
            if min(size) <= 2 * MARGIN_PX:
                break
            levels.append(np.asarray(cv2.resize(levels[-1], size, interpolation=cv2.INTER_LINEAR), np.uint8))
        return levels

    def _corners(self, levels: list[NDArray[np.uint8]], noise: FloatArray) -> list[Corners]:
        """Candidate corners and their scores, level by level."""
        corners = self._detected(levels, noise, self.options.fast_thresholds, [None] * len(levels))
        if sum(len(xy) for xy, _ in corners) >= self.n_features:
            return corners
        return self._detected(levels, noise, (self.options.fast_threshold_last,), corners)

    def _detected(
        self,
        levels: list[NDArray[np.uint8]],
        noise: FloatArray,
        thresholds: tuple[int, ...],
        known: Sequence[Corners | None],
    ) -> list[Corners]:
        corners = []
        for level, sigma, of_level in zip(levels, noise.tolist(), known, strict=True):
            lowest = min(ceil(NOISE_CONTRAST * sigma), MAX_THRESHOLD)
            at_least = [max(threshold, lowest) for threshold in thresholds]
            corners.append(detect_corners(level, at_least, MARGIN_PX, self.options.cell_px, of_level))
        return corners

    def _spread(
        self, levels: list[NDArray[np.uint8]], corners: list[Corners]
    ) -> tuple[list[IntArray], IntArray, NDArray[np.uint8]]:
        """Choose among the corners of all levels; with their octaves and the patches about them."""
        # As many per octave as its side is long: fine corners are the more accurate, coarse ones live the longer.
        weights = self.scale_factor ** -np.arange(len(levels), dtype=np.float64)
        quotas = share_out([len(xy) for xy, _ in corners], weights, self.n_features)
        chosen = [xy[select_spread(xy, response, quota)] for (xy, response), quota in zip(corners, quotas, strict=True)]
        octave = np.repeat(np.arange(len(levels)), [len(xy) for xy in chosen])
        patches = np.concatenate([_patches(level, xy) for level, xy in zip(levels, chosen, strict=True)])
        return chosen, octave, patches

    def _angles(self, patches: NDArray[np.uint8]) -> FloatArray:
        """Direction from each patch's centre to its centre of mass, (N,)."""
        moments = np.empty((len(patches), 2), np.float32)
        for begin in range(0, len(patches), PATCHES_AT_ONCE):
            part = patches[begin : begin + PATCHES_AT_ONCE].reshape(-1, PATCH_SIDE_PX**2)
            np.matmul(part.astype(np.float32), self._moments, out=moments[begin : begin + len(part)])
        return np.asarray(np.arctan2(moments[:, 1], moments[:, 0]), np.float64)

    def _descriptors(
        self, levels: list[NDArray[np.uint8]], corners: list[IntArray], angle_rad: FloatArray
    ) -> NDArray[np.uint8]:
        """Rotated BRIEF at whole pixels of each level, (N, 32) uint8; `angle_rad` runs through all of them."""
        # One level and no border of its own: the pyramid and the rim are ours. Made anew each time, which costs
        # nothing, because a front end that holds it could not be sent to another process.
        orb = cv2.ORB.create(nfeatures=1, nlevels=1, edgeThreshold=0, patchSize=PATCH_SIDE_PX)
        turns = iter((np.degrees(angle_rad) % 360.0).tolist())  # one by one, across the levels
        rows = [np.empty((0, DESCRIPTOR_BYTES), np.uint8)]
        for level, xy in zip(levels, corners, strict=True):
            if len(xy) == 0:
                continue
            keypoints = list(map(cv2.KeyPoint, *xy.T.tolist(), repeat(PATCH_SIDE_PX), turns))
            kept, descriptors = orb.compute(level, keypoints)
            assert len(kept) == len(xy), "cv2.ORB dropped keypoints although it was given no border"
            rows.append(np.asarray(descriptors, np.uint8))
        return np.concatenate(rows)


def _placed(levels: list[NDArray[np.uint8]], corners: list[Corners], noise: FloatArray) -> list[Corners]:
    """Those of each level's corners that are not placed by its noise."""
    found = []
    for level, (xy, response), sigma in zip(levels, corners, noise.tolist(), strict=True):
        kept = stand_out(find_peaks(_patches(level, xy)), np.full(len(xy), sigma))
        found.append((xy[kept], response[kept]))
    return found


def _patches(level: NDArray[np.uint8], xy: IntArray) -> NDArray[np.uint8]:
    """The square around each corner (N, 2) of a level, (N, PATCH_SIDE_PX, PATCH_SIDE_PX)."""
    if len(xy) == 0:
        return np.empty((0, PATCH_SIDE_PX, PATCH_SIDE_PX), np.uint8)
    windows = sliding_window_view(level, (PATCH_SIDE_PX, PATCH_SIDE_PX))
    return windows[xy[:, 1] - PATCH_RADIUS_PX, xy[:, 0] - PATCH_RADIUS_PX]


def _moment_weights() -> NDArray[np.float32]:
    """(PATCH_SIDE_PX^2, 2): first moments (u, v) over the disc of a patch."""
    reach = np.arange(-PATCH_RADIUS_PX, PATCH_RADIUS_PX + 1, dtype=np.float32)
    u, v = np.meshgrid(reach, reach)
    disc = u**2 + v**2 <= (PATCH_RADIUS_PX + 0.5) ** 2
    return np.stack([u * disc, v * disc], axis=-1).reshape(-1, 2)
