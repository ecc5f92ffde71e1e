"""Which pixels show the scene: the rest is painted over before features are found, and has none."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.grey_image import GreyImage
from dualslam.core.types import BoolArray, Failure, FailureReason, Features, Frame, View
from dualslam.frontends.features.images import to_grey
from dualslam.frontends.still_pixels import StillPixels

U8Image = NDArray[np.uint8]
F32Image = NDArray[np.float32]

SUPPORT_PX = 4.0
"""Distance from hidden pixels that a feature of the finest level keeps: FAST reads a circle of three pixels."""
BLOCK_PX = 8
"""Side of the squares by whose means hidden pixels are painted over."""
MIN_WEIGHT = 0.05
"""Share of the surroundings that shows the scene at least where a mean is taken from them; else from wider ones."""


@dataclass(frozen=True, slots=True, eq=False)
class Cover:
    """Pixels that show no scene, made ready for images and features."""

    hidden: BoolArray  # (H, W): some of them, and not all
    distance_px: F32Image  # (H, W) float32: from each pixel to the nearest hidden one

    @classmethod
    def of(cls, hidden: BoolArray) -> Cover:
        """Make it of hidden pixels."""
        return cls(hidden, np.asarray(cv2.distanceTransform((~hidden).astype(np.uint8), cv2.DIST_L2, 5), np.float32))

    def shows(self, features: Features) -> BoolArray:
        """Return which features (N,) are of the scene alone."""
        height, width = self.hidden.shape
        u = np.clip(np.rint(features.uv_px[:, 0]).astype(np.int64), 0, width - 1)
        v = np.clip(np.rint(features.uv_px[:, 1]).astype(np.int64), 0, height - 1)
        return np.asarray(self.distance_px[v, u] > SUPPORT_PX * features.scale)

    def paint(self, image: U8Image) -> U8Image:
        """Return a copy of an image whose hidden pixels continue the others smoothly: no detector finds edges there."""
        height, width = self.hidden.shape
        small = (max(width // BLOCK_PX, 1), max(height // BLOCK_PX, 1))
        scene = (~self.hidden).astype(np.float32)
        visible = image * (scene if image.ndim == 2 else scene[:, :, None])
        total, weight = (cv2.resize(each, small, interpolation=cv2.INTER_AREA) for each in (visible, scene))
        filled = _spread(np.asarray(total, np.float32), np.asarray(weight, np.float32))
        smooth = cv2.resize(filled, (width, height), interpolation=cv2.INTER_LINEAR)
        painted = image.copy()
        painted[self.hidden] = np.clip(np.rint(smooth[self.hidden]), 0, 255).astype(np.uint8)
        return painted


def _spread(total: F32Image, weight: F32Image) -> F32Image:
    """Return weighted means of ever wider surroundings, the narrowest that have any weight."""
    result, lacks, sigma = np.zeros_like(total), np.ones(weight.shape, np.bool_), 1.0
    while lacks.any():
        sums, weights = (np.asarray(cv2.GaussianBlur(each, (0, 0), sigma)) for each in (total, weight))
        taken = lacks & ((weights >= MIN_WEIGHT) | (sigma > max(weight.shape)))
        divisor = np.maximum(weights[taken], 1e-6)
        result[taken] = sums[taken] / (divisor if total.ndim == 2 else divisor[:, None])
        lacks &= ~taken
        sigma *= 2
    return result


class SceneMask:
    """Tells which pixels show the scene: those that a frame's own mask leaves, and that do not stand `still`."""

    def __init__(self, still: StillPixels | None) -> None:
        self._still = still
        self._cover: tuple[BoolArray | None, BoolArray | None, Cover | None] = (None, None, None)

    @property
    def hidden(self) -> BoolArray | None:
        """Return the pixels (H, W) that were found to stand still; None while there are none."""
        return None if self._still is None else self._still.hidden

    @property
    def camera_stands(self) -> bool:
        """Whether most of the image stands still, and something moves through it."""
        return self._still is not None and self._still.camera_stands

    def refuse_start(self) -> Failure | None:
        """Return why no map should start now; None where one may."""
        if self.camera_stands:
            return Failure(FailureReason.CAMERA_STANDS, "the camera stands still, and something moves before it")
        if self._still is not None and self._still.is_suspicious:
            return Failure(FailureReason.BUSY, "part of the image seems to stand still: it is looked at first")
        return None

    def look(self, frame: Frame) -> None:
        """Take a frame in that has an image."""
        if self._still is not None and frame.image is not None:
            self._still.look(frame.timestamp_s, to_grey(frame.image), frame.hidden)

    def cover_of(self, frame: Frame) -> Cover | None:
        """Return what hides parts of a frame's image; None where nothing does."""
        own, found = frame.hidden, self.hidden
        known_own, known_found, cover = self._cover
        if own is not known_own or found is not known_found:
            masks = [mask for mask in (own, found) if mask is not None]
            hidden = np.logical_or.reduce(masks) if masks else None
            cover = None if hidden is None or not hidden.any() else Cover.of(hidden)
            self._cover = own, found, cover
        return cover

    def painted(self, frame: Frame) -> Frame:
        """Return a frame as the front end is to see it."""
        cover = self.cover_of(frame)
        return frame if cover is None or frame.image is None else replace(frame, image=cover.paint(frame.image))

    def shows(self, features: Features) -> BoolArray:
        """Return which features (N,) of any frame are not of pixels that stand still."""
        return np.ones(len(features), np.bool_) if self.hidden is None else Cover.of(self.hidden).shows(features)

    def masked(self, view: View) -> View:
        """Return a view of an earlier frame without what stands still."""
        if self.hidden is None:
            return view
        cover = self.cover_of(Frame(view.index, view.timestamp_s, None))
        assert cover is not None, "found pixels hide something"
        image = None if view.image is None else GreyImage.of(cover.paint(view.image.pixels()))
        return replace(view, features=view.features.take(cover.shows(view.features)), image=image)
