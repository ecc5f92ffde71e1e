"""A flat scene that can be photographed from anywhere: exact truth for the conformance suite, without any file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.interfaces import Frontend
from dualslam.core.types import Features, FloatArray
from dualslam.frontends.registry import FrontendFactory

TEXELS = 3
"""Texture elements along a pixel of the straight view, and samples along a pixel of any view."""
MARGIN_PX = 160
"""Width of the scene about what the straight view shows."""


@dataclass(frozen=True, slots=True, eq=False)
class PrintedPlane:
    """A printed plane, `size_px` wide and high in the straight view."""

    texture: NDArray[np.uint8]  # (H, W): the print, `TEXELS` to a pixel, `MARGIN_PX` pixels wider on every side
    size_px: tuple[int, int]  # (width, height)

    @classmethod
    def printed(cls, seed: int, size_px: tuple[int, int] = (480, 360)) -> PrintedPlane:
        """Blobs, bars and triangles of 2 to 40 pixels."""
        rng = np.random.default_rng([seed, 0x5CE])
        width, height = (TEXELS * (side + 2 * MARGIN_PX) for side in size_px)
        texture = np.full((height, width), 128, np.uint8)
        sizes = np.exp(rng.uniform(np.log(2.0), np.log(40.0), width * height // (TEXELS**2 * 90)))
        for size in np.sort(sizes)[::-1].tolist():  # large ones first, so that they do not hide the small ones
            centre, grey = rng.uniform(0, 1, 2) * (width, height), int(rng.integers(10, 246))
            corners = centre + TEXELS * size * rng.uniform(-1, 1, (int(rng.integers(3, 5)), 2))
            if rng.random() < 0.4:
                axes = np.maximum(TEXELS * size * rng.uniform(0.3, 0.8, 2), 1)
                cv2.ellipse(
                    texture, (tuple(centre.tolist()), tuple(axes.tolist()), float(rng.uniform(0, 180))), grey, -1
                )
            else:
                cv2.fillConvexPoly(texture, cv2.convexHull(corners.astype(np.float32)).astype(np.int32), grey)
        return cls(np.asarray(cv2.GaussianBlur(texture, (0, 0), TEXELS / 3), np.uint8), size_px)

    @classmethod
    def of_discs(cls, centres_px: FloatArray, radius_px: float, size_px: tuple[int, int]) -> PrintedPlane:
        """Bright discs (N, 2) on grey, exact to a hundredth of a pixel."""
        width, height = (TEXELS * (side + 2 * MARGIN_PX) for side in size_px)
        texture = np.full((height, width), 60.0, np.float32)
        reach = int(TEXELS * radius_px) + 16
        for centre_u, centre_v in _texel(centres_px).tolist():
            left, top = int(centre_u) - reach, int(centre_v) - reach
            u, v = left + np.arange(2 * reach), top + np.arange(2 * reach)[:, None]
            rim = TEXELS * radius_px - np.hypot(u - centre_u, v - centre_v)
            texture[top : top + 2 * reach, left : left + 2 * reach] += 140.0 / (1.0 + np.exp(-2.0 * rim))
        return cls(np.rint(texture).astype(np.uint8), size_px)

    def photograph(
        self, H_view_scene: FloatArray | None = None, noise: float = 2.0, seed: int = 0
    ) -> NDArray[np.uint8]:
        """Return the image of a camera.

        - `H_view_scene` (3, 3): takes pixels of the straight view to pixels of this one; the straight view itself by
          default. Pixel (0, 0) is the centre of the top-left pixel.
        - `noise`: of the sensor, grey levels, other for every `seed`.

        Returns (height, width) uint8.
        """
        width, height = self.size_px
        # Samples of the view, from the texture: pixel p holds samples 3 p to 3 p + 2.
        to_sample = np.array([[TEXELS, 0, (TEXELS - 1) / 2], [0, TEXELS, (TEXELS - 1) / 2], [0, 0, 1]])
        to_texel = to_sample.copy()
        to_texel[:2, 2] += TEXELS * MARGIN_PX
        H = to_sample @ (np.eye(3) if H_view_scene is None else H_view_scene) @ np.linalg.inv(to_texel)
        samples = cv2.warpPerspective(
            self.texture,
            H,
            (TEXELS * width, TEXELS * height),
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT_101,
        )
        image = cv2.resize(np.asarray(samples, np.float32), (width, height), interpolation=cv2.INTER_AREA)
        image = cv2.GaussianBlur(image, (0, 0), 0.6)
        grain = np.random.default_rng([seed, 0x9A1]).normal(0, noise, image.shape)
        return np.clip(np.rint(image + grain), 0, 255).astype(np.uint8)


def turned(degrees: float, zoom: float, size_px: tuple[int, int]) -> FloatArray:
    """(3, 3): the view of a camera turned about its axis, the image content clockwise, and nearer by `zoom`."""
    middle = np.array([(side - 1) / 2 for side in size_px])
    angle = np.radians(degrees)
    H = np.eye(3)
    H[:2, :2] = zoom * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    H[:2, 2] = middle - H[:2, :2] @ middle + (1.3, -0.7)
    return H


def tilted(size_px: tuple[int, int]) -> FloatArray:
    """(3, 3): a view from the side, a little turned: what two frames of a video may differ by."""
    H = turned(4.0, 0.96, size_px)
    H[2, :2] = (1.2e-4, -0.8e-4)
    return H / (H @ np.array([size_px[0] / 2, size_px[1] / 2, 1.0]))[2]


def transfer(H: FloatArray, uv_px: FloatArray) -> FloatArray:
    """Pixels (N, 2) through a homography."""
    homogeneous = np.concatenate([uv_px, np.ones((len(uv_px), 1))], axis=1) @ H.T
    return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:])


def local_zoom(H: FloatArray, uv_px: FloatArray) -> FloatArray:
    """How much larger things are in the second view at each pixel (N, 2) of the first, (N,)."""
    w = uv_px @ H[2, :2] + H[2, 2]
    zoom: FloatArray = np.sqrt(np.abs(np.linalg.det(H) / w**3))
    return zoom


def _texel(uv_px: FloatArray) -> FloatArray:
    """Place in the texture of pixels (N, 2) of the straight view."""
    return TEXELS * (uv_px + MARGIN_PX) + (TEXELS - 1) / 2


N_FEATURES = 800
FEATURES_ARRAYS = ("uv_px", "uv_rect_px", "sigma_px", "scale", "octave", "angle_rad", "descriptors")


@dataclass(frozen=True, slots=True)
class Subject:
    """The front end under examination, and the scene that it is shown."""

    factory: FrontendFactory  # what the entry point names
    options: Mapping[str, Any] = field(default_factory=dict)  # `frontend.options` to build it with

    def make(self, n_features: int = N_FEATURES) -> Frontend:
        """Build it anew."""
        return self.factory.from_options(n_features, self.options)

    def scene(self, seed: int = 1) -> PrintedPlane:
        """Return a flat scene full of blobs, bars and corners."""
        return _printed(seed)

    def image(self, H_view_scene: FloatArray | None = None, seed: int = 0) -> NDArray[np.uint8]:
        """Photograph that scene (`PrintedPlane.photograph`)."""
        return self.scene().photograph(H_view_scene, seed=seed)


@lru_cache(maxsize=2)
def _printed(seed: int) -> PrintedPlane:
    """The scene of a seed: drawing one takes longer than most checks."""
    return PrintedPlane.printed(seed)


def same_features(a: Features, b: Features) -> bool:
    """Whether two sets of features are equal bit for bit."""
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in FEATURES_ARRAYS)
