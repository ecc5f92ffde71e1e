"""A pixel matcher of another package: KLT from the last frame, forwards and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dualslam.core.camera.base import Camera
from dualslam.core.config.settings import StrictModel
from dualslam.core.matchers import PixelMatches, PosedImage
from dualslam.core.types import FloatArray
from dualslam.frontends.registry import MATCHERS, parse_options


class KltOptions(StrictModel):
    """`pixels.options` of this matcher."""

    window_px: int = Field(31, ge=5)
    """Side of the window that is followed; a blurred image shows nothing in a small one."""
    n_levels: int = Field(4, ge=1)
    """Of the image pyramid."""
    max_return_px: float = Field(1.0, gt=0)
    """By how much a point may miss its start when it is followed back."""
    sigma_px: float = Field(0.5, gt=0)
    """Noise of a followed point."""


class KltMatcher:
    """Implements `dualslam.core.interfaces.PixelMatcher`."""

    name = "klt"

    def __init__(self, options: KltOptions | None = None) -> None:
        self.options = options or KltOptions()

    @classmethod
    def from_options(cls, options: Mapping[str, Any]) -> KltMatcher:
        """Build from the config."""
        return cls(parse_options(KltOptions, cls.name, options, MATCHERS))

    def find(
        self,
        references: tuple[PosedImage, ...],
        image: NDArray[np.uint8],
        camera: Camera,
        T_cam_submap: FloatArray,
    ) -> PixelMatches:
        """Follow the landmarks of the last frame, from where they were in it."""
        last, options = references[0], self.options
        before = last.uv_px.astype(np.float32).reshape(-1, 1, 2)
        window: dict[str, Any] = {"winSize": (options.window_px, options.window_px), "maxLevel": options.n_levels - 1}
        after, seen, _ = cv2.calcOpticalFlowPyrLK(last.image, image, before, np.empty_like(before), **window)
        back, seen_back, _ = cv2.calcOpticalFlowPyrLK(image, last.image, after, np.empty_like(after), **window)
        uv_px = after.reshape(-1, 2).astype(np.float64)
        returned = np.linalg.norm((back - before).reshape(-1, 2), axis=1) < options.max_return_px
        inside = ((uv_px >= 0) & (uv_px <= np.array(camera.size_px) - 1)).all(axis=1)
        row = np.flatnonzero(returned & inside & (seen.ravel() > 0) & (seen_back.ravel() > 0))
        return PixelMatches(last.landmark_ids[row], uv_px[row], np.full(len(row), options.sigma_px))
