"""RootSIFT features (Lowe 2004; Arandjelovic and Zisserman 2012), well spread, with descriptors of one byte a number.

The defaults of noise and distances were measured on pairs of KITTI and 7-Scenes:
`docs/notes/2026-11-28-noise-and-distances-of-orb-and-sift.md`.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dualslam.core.config.settings import StrictModel
from dualslam.core.types import BoolArray, Features, FloatArray, IntArray, Matches
from dualslam.frontends.features.corners import grades, select_spread, share_out
from dualslam.frontends.features.groups import consistent_rotation, mutual_best
from dualslam.frontends.features.images import to_grey
from dualslam.frontends.registry import N_FEATURES, OptionedFrontend

DESCRIPTOR_LENGTH = 128
UNIT = 512
"""Length of a descriptor in steps of its bytes. A step's rounding moves a distance by less than 0.01."""
BASE_SIGMA_PX = 1.6
"""Blur of the first level of an octave (Lowe, section 3.3); the image is taken twice as large at first."""
MIN_SIDE_PX = 16
"""A descriptor at the finest level reads a square of this side; smaller images have no features."""
CONTENDERS = 2
"""Of so many times the keypoints that are asked for, the strongest, those are chosen that cover the image. If all that
there are took part, the choice would change from frame to frame, and a quarter fewer landmarks be found again."""
CELL_PX = 64
"""Squares of this side without any of the strongest let their weak ones take part."""
BLOCK_ROWS = 1024
"""Descriptor pairs compared at a time, so that the scratch stays in the cache."""


class SiftOptions(StrictModel):
    """`frontend.options` of the SIFT front end."""

    levels_per_doubling: int = Field(3, ge=1, le=8)
    """Pyramid levels in which the size of the patch doubles; Lowe found 3 the most repeatable."""
    n_octaves: int = Field(10, ge=1, le=32)
    """Number of pyramid levels; with 10, patches are 12 to 96 pixels wide. Larger ones are few and inaccurate."""
    contrast_threshold: float = Field(0.01, gt=0.0, lt=1.0)
    """Least height of an extremum, of the range of greys. Low, since the choice is made among neighbours: a weak
    keypoint is taken only where there is no strong one."""
    edge_ratio: float = Field(10.0, gt=1.0)
    """Greatest ratio of the curvatures of an extremum: beyond it, it is an edge."""
    sigma_floor_px: float = Field(0.15, gt=0.0)
    """Noise of a position that all scales share, pixels of the image (see the note)."""
    sigma_px: float = Field(0.15, gt=0.0)
    """Noise of a position that grows with the scale: its size at the finest level."""
    max_distance: float = Field(0.55, gt=0.0, le=1.5)
    """Distance of unit vectors up to which a guided match is believed (see the note)."""
    max_distance_strict: float = Field(0.4, gt=0.0, le=1.5)
    """The same without a guide."""
    ratio: float = Field(0.8, gt=0.0, le=1.0)
    """`match_wide`: greatest distance of the best match over that of the second best (Lowe, figure 11)."""


class SiftFrontend(OptionedFrontend):
    """Difference-of-Gaussian extrema, gradient orientation, RootSIFT descriptors. Implements `Frontend`."""

    name = "sift"
    options: SiftOptions
    options_model = SiftOptions
    max_turn_deg = 180.0
    max_zoom = 2.0

    def __init__(self, n_features: int = N_FEATURES, options: SiftOptions | None = None) -> None:
        super().__init__(n_features, options)
        self.scale_factor = float(2.0 ** (1.0 / self.options.levels_per_doubling))
        self.n_octaves = self.options.n_octaves
        self.max_distance = self.options.max_distance
        self.max_distance_strict = self.options.max_distance_strict

    def extract(self, image: NDArray[np.uint8]) -> Features:
        """Detect and describe up to `n_features` extrema, as `Frontend.extract` says, the finest octave first."""
        grey = to_grey(image)
        detector = self._detector()
        found = detector.detect(grey) if min(grey.shape) >= MIN_SIDE_PX else ()
        scale = self._scales(found)
        octave = np.rint(np.log(scale) / np.log(self.scale_factor)).astype(np.int64)
        chosen = self._choose(found, octave)
        keypoints = [found[row] for row in chosen.tolist()]
        uv = np.array([each.pt for each in keypoints], np.float64).reshape(-1, 2)
        angle = np.radians(np.array([each.angle for each in keypoints], np.float64))
        descriptors = np.empty((0, DESCRIPTOR_LENGTH), np.float32)
        if keypoints:
            kept, descriptors = detector.compute(grey, keypoints)
            assert len(kept) == len(keypoints), "cv2.SIFT dropped keypoints that it had found itself"
        scale = np.maximum(scale[chosen], 1.0)
        sigma = np.hypot(self.options.sigma_floor_px, self.options.sigma_px * scale)
        return Features(uv, uv, sigma, scale, octave[chosen], angle, _root(np.asarray(descriptors)))

    def distance(self, a: NDArray[np.generic], b: NDArray[np.generic]) -> FloatArray:
        """Euclidean distance of paired unit vectors (N, 128), (N, 128) uint8 -> (N,) float64, 0 to 1.42."""
        squared = np.empty(len(a))
        for begin in range(0, len(a), BLOCK_ROWS):
            rows = slice(begin, begin + BLOCK_ROWS)
            step = a[rows].astype(np.float32)
            step -= b[rows].astype(np.float32)
            squared[rows] = np.einsum("ij,ij->i", step, step)
        return np.asarray(np.sqrt(squared) / UNIT, np.float64)

    def distances(self, a: NDArray[np.generic], b: NDArray[np.generic]) -> FloatArray:
        """`distance` of all pairs (N, 128), (M, 128) -> (N, M)."""
        return np.asarray(np.sqrt(_squared_matrix(a, b).astype(np.float64)) / UNIT, np.float64)

    def match_wide(self, a: Features, b: Features) -> Matches:
        """Compare all with all: mutually nearest, clearly so, within `max_distance_strict`, turned alike."""
        limit = (self.max_distance_strict * UNIT) ** 2
        found = mutual_best(_squared_matrix(a.descriptors, b.descriptors), self.options.ratio**2, limit)
        kept = consistent_rotation(b.angle_rad[found.index[:, 1]] - a.angle_rad[found.index[:, 0]])
        return Matches(found.index[kept], np.sqrt(found.distance[kept]) / UNIT)

    def _detector(self) -> Any:
        # Made anew each time, which costs nothing, because a front end that holds it could not be sent to another
        # process. The precise upscaling keeps pixel centres where they are: without it all is off by a quarter pixel.
        levels, contrast = self.options.levels_per_doubling, self.options.contrast_threshold
        return cv2.SIFT.create(0, levels, contrast, self.options.edge_ratio, BASE_SIGMA_PX, cv2.CV_32F, True)

    def _scales(self, keypoints: tuple[cv2.KeyPoint, ...]) -> FloatArray:
        """Scale of each keypoint; 1 is the finest level that has extrema, but the fit may go half a level below."""
        # OpenCV's size is twice the blur in pixels; the finest level is the second one of the doubled image.
        finest_px = 2.0 * (BASE_SIGMA_PX / 2.0) * self.scale_factor
        return np.array([each.size for each in keypoints], np.float64) / finest_px

    def _choose(self, keypoints: tuple[cv2.KeyPoint, ...], octave: IntArray) -> IntArray:
        """Rows of the strongest that cover the image, octave by octave, finest first."""
        xy = np.array([each.pt for each in keypoints], np.float64).reshape(-1, 2).astype(np.int64)
        response = np.array([each.response for each in keypoints], np.float64)
        contender = self._contenders(xy, response, octave < self.n_octaves)
        levels = [np.flatnonzero(contender & (octave == level)) for level in range(self.n_octaves)]
        # As many per octave as its side is long: fine ones are the more accurate, coarse ones live the longer.
        weights = self.scale_factor ** -np.arange(self.n_octaves, dtype=np.float64)
        quotas = share_out([len(rows) for rows in levels], weights, self.n_features)
        return np.concatenate(
            [rows[select_spread(xy[rows], grades(response[rows]), n)] for rows, n in zip(levels, quotas, strict=True)]
        )

    def _contenders(self, xy: IntArray, response: FloatArray, usable: BoolArray) -> BoolArray:
        """The strongest of those that are usable, and in parts of the image that have none of these, all."""
        strong = np.zeros(len(xy), np.bool_)
        usable_rows = np.flatnonzero(usable)
        by_strength = usable_rows[np.argsort(response[usable_rows], kind="stable")]
        strong[by_strength[-CONTENDERS * self.n_features :]] = True
        column, row = xy.T // CELL_PX
        cell = row * 4096 + column
        return strong | (usable & ~np.isin(cell, cell[strong]))


def _root(descriptors: NDArray[np.float32]) -> NDArray[np.uint8]:
    """RootSIFT: the square root of each share of the sum, as whole steps of 1 / UNIT; (N, 128) uint8."""
    total = np.maximum(descriptors.sum(axis=1, keepdims=True), 1.0)
    return np.asarray(np.minimum(np.rint(UNIT * np.sqrt(descriptors / total)), 255), np.uint8)


def _squared_matrix(a: NDArray[np.generic], b: NDArray[np.generic]) -> NDArray[np.float32]:
    """Squared distances of all pairs in steps, (N, M), as one product: [a, |a|^2, 1] [-2 b, 1, |b|^2]^T.

    Single precision is exact: all terms are whole numbers below 2^24, in whatever order they are added.
    """
    wide_a, wide_b = (np.ones((len(each), DESCRIPTOR_LENGTH + 2), np.float32) for each in (a, b))
    wide_a[:, :DESCRIPTOR_LENGTH], wide_b[:, :DESCRIPTOR_LENGTH] = a, b
    wide_a[:, -2] = np.einsum("ij,ij->i", wide_a[:, :DESCRIPTOR_LENGTH], wide_a[:, :DESCRIPTOR_LENGTH])
    wide_b[:, -1] = np.einsum("ij,ij->i", wide_b[:, :DESCRIPTOR_LENGTH], wide_b[:, :DESCRIPTOR_LENGTH])
    wide_b[:, :DESCRIPTOR_LENGTH] *= -2.0
    return np.asarray(wide_a @ wide_b.T)
