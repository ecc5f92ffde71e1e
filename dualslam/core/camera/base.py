"""Base of camera models: raw pixels, rays and rectified pixels, a form for files, and a check of the numbers.

A model hides its lens: the rest of the system sees rectified pixels of a pinhole with intrinsics `K`. Pixel (0, 0) is
the centre of the top-left pixel. The camera looks along +z, x right, y down.
"""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from dualslam.core.errors import InputError
from dualslam.core.types import BoolArray, Features, FloatArray

MAX_RECTIFIED_ANGLE_RAD = math.radians(80.0)
"""Rays farther from the axis have no useful place in a pinhole image: `Camera.rectify` makes them NaN."""

FOCAL_OVER_LONGER_SIDE = (0.05, 100.0)
"""What a focal length in pixels may be: a fisheye of 220 degrees has 0.26, a field of half a degree 100. Outside are
focal lengths in millimetres or of normalised coordinates, and slips of an exponent."""
MAX_PIXEL_ASPECT = 2.5
"""Of fx to fy. One field of interlaced video has 2; more is a slip in a digit."""


@dataclass(frozen=True)
class Camera(ABC):
    """A calibrated camera: raw pixels of its image, rays, and rectified pixels."""

    model: ClassVar[str]  # name of the class in files
    corners_matter: ClassVar[bool] = True
    """Whether `validate` wants an inverse in the corners of the image, or only at the middle of its sides. The circle
    of a fisheye lens may end before, beyond the last ray that `rectify` keeps."""

    # Of the raw image, pixels.
    width: int
    height: int
    # Of the raw image, pixels: raw pixel = (fx x + cx, fy y + cy) for distorted normalised (x, y).
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        """Refuse a calibration that makes no sense: see `validate`."""
        self.validate()

    @abstractmethod
    def _distort(self, p_cam: FloatArray) -> FloatArray:
        """Return distorted normalised coordinates (N, 2) of points (N, 3), NaN where they are not imaged."""

    @abstractmethod
    def _undistort(self, xy_distorted: FloatArray) -> FloatArray:
        """Return rays (N, 3), of any positive length, of distorted normalised coordinates, NaN outside the model."""

    @abstractmethod
    def _area_ratio(self, xy: FloatArray) -> FloatArray:
        """Return the determinant (N,) of d(distorted)/d(undistorted) at undistorted normalised coordinates."""

    def _centre_zoom(self) -> float:
        """Return the derivative of distorted by undistorted coordinates on the axis."""
        return 1.0

    @staticmethod
    def read(path: str | Path) -> Camera:
        """Read a calibration from a file of any known format (docs/calibration.md).

        Raises `InputError`.
        """
        reader = import_module("dualslam.io.camera_files")  # by name: readers of files stand above this room
        camera: Camera = reader.read_camera_file(path)
        return camera

    @property
    def K(self) -> FloatArray:
        """(3, 3) intrinsics of the rectified pixels: the pinhole camera with the same magnification on the axis."""
        zoom = self._centre_zoom()
        return np.array([[self.fx * zoom, 0.0, self.cx], [0.0, self.fy * zoom, self.cy], [0.0, 0.0, 1.0]])

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) of the raw image."""
        return self.width, self.height

    def project(self, p_cam: ArrayLike) -> FloatArray:
        """Return raw pixels (N, 2) of points (N, 3) in the camera frame, NaN where they are not imaged."""
        xy = self._distort(np.asarray(p_cam, np.float64).reshape(-1, 3))
        return xy * (self.fx, self.fy) + (self.cx, self.cy)

    def unproject(self, uv: ArrayLike) -> FloatArray:
        """Return unit rays (N, 3) in the camera frame of raw pixels (N, 2), NaN outside the model's domain."""
        rays = self._undistort((np.asarray(uv, np.float64).reshape(-1, 2) - (self.cx, self.cy)) / (self.fx, self.fy))
        return np.asarray(rays / np.sqrt((rays * rays).sum(1, keepdims=True)), np.float64)

    def rectify(self, uv: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Take raw pixels to rectified ones.

        `uv` (N, 2).

        Returns pixels (N, 2) of the pinhole camera `K`, NaN for rays beyond `MAX_RECTIFIED_ANGLE_RAD` or outside the
        model; and the zoom (N,): the root of the determinant of d(uv_rect)/d(uv). A raw sigma times this is the
        rectified pixel's.
        """
        rays = self.unproject(uv)
        z = np.where(rays[:, 2] > math.cos(MAX_RECTIFIED_ANGLE_RAD), rays[:, 2], np.nan)
        xy = rays[:, :2] / z[:, None]
        K = self.K
        ratio = self._area_ratio(xy)
        magnification = self._centre_zoom() / np.sqrt(np.where(ratio > 0, ratio, np.nan))
        return xy * (K[0, 0], K[1, 1]) + K[:2, 2], magnification

    def unrectify(self, uv_rect: FloatArray) -> FloatArray:
        """Take rectified pixels (N, 2) to raw ones: the inverse of `rectify`; NaN for rays that it has no pixel for."""
        K = self.K
        xy = (uv_rect - K[:2, 2]) / (K[0, 0], K[1, 1])
        near_axis = np.einsum("ij,ij->i", xy, xy) < math.tan(MAX_RECTIFIED_ANGLE_RAD) ** 2
        return self.project(lift(np.where(near_axis[:, None], xy, np.nan)))

    def shows(self, uv_rect: FloatArray) -> BoolArray:
        """Return which rectified pixels (N, 2) are in the image: a lens leaves no rectangle of them. NaN is not."""
        u, v = self.unrectify(uv_rect).T
        inside = (u >= 0) & (v >= 0) & (u <= self.width - 1) & (v <= self.height - 1)
        return np.asarray(inside, np.bool_)

    def scaled(self, factor: float) -> Self:
        """Return the camera of the image resized by `factor` (sizes rounded, intrinsics follow the rounded sizes)."""
        return self.resized(max(round(self.width * factor), 1), max(round(self.height * factor), 1))

    def resized(self, width: int, height: int) -> Self:
        """Return the camera of the whole image resized to `width` x `height` pixels."""
        sx, sy = width / self.width, height / self.height
        return dataclasses.replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and the name of the model, for YAML or JSON."""
        return {"model": self.model, **dataclasses.asdict(self)}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Return the camera of what `to_dict` gave.

        Raises `InputError`: names the field that is missing, unknown or not a number.
        """
        names = {f.name: f for f in dataclasses.fields(cls)}
        given = {name: value for name, value in values.items() if name != "model"}
        for name, value in given.items():
            if name not in names:
                raise InputError(f"camera: unknown field '{name}' for model '{cls.model}'; it has {', '.join(names)}")
            if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
                raise InputError(f"camera: field '{name}' must be a number, not {value!r}")
        for name, field in names.items():
            if name not in given and field.default is dataclasses.MISSING:
                raise InputError(f"camera: field '{name}' is missing for model '{cls.model}'")
        sizes = ("width", "height")
        for name in sizes:
            if not math.isfinite(given[name]) or int(given[name]) != given[name]:
                raise InputError(f"camera: field '{name}' must be a whole number of pixels, not {given[name]!r}")
        numbers: dict[str, Any] = {name: int(v) if name in sizes else float(v) for name, v in given.items()}
        return cls(**numbers)

    def validate(self) -> None:
        """Check the calibration.

        Raises `InputError`: one sentence that names the field.
        """
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not math.isfinite(value):
                raise InputError(f"camera: {field.name} is {value}, it must be finite")
        for name in ("width", "height", "fx", "fy"):
            if getattr(self, name) <= 0:
                raise InputError(f"camera: {name} is {getattr(self, name)}, it must be positive")
        for name in ("fx", "fy"):
            low, high = (share * max(self.size_px) for share in FOCAL_OVER_LONGER_SIDE)
            if not low <= getattr(self, name) <= high:
                raise InputError(
                    f"camera: {name} is {getattr(self, name):g}, for images of {self.width} x {self.height} it must be "
                    f"{low:g} to {high:g} pixels"
                )
        if not 1.0 / MAX_PIXEL_ASPECT <= self.fx / self.fy <= MAX_PIXEL_ASPECT:
            raise InputError(f"camera: fx is {self.fx:g} and fy {self.fy:g}; they should be nearly equal")
        for name, size in (("cx", self.width), ("cy", self.height)):
            if not -0.5 <= getattr(self, name) <= size - 0.5:
                raise InputError(f"camera: {name} is {getattr(self, name)}, outside of the image of {size} pixels")
        outside = np.isnan(self.unproject(self._border())).any(1)
        if outside.any() and not self.corners_matter:
            outside &= ~self._reaches_beyond_use(self._border())
        if outside.any():
            u, v = self._border()[int(np.argmax(outside))]
            raise InputError(
                f"camera: the distortion of model '{self.model}' has no inverse at pixel ({u:.0f}, {v:.0f})"
            )

    def _reaches_beyond_use(self, uv: FloatArray) -> BoolArray:
        """Return towards which pixels (N, 2) the model images every ray that `rectify` keeps."""
        towards = (uv - (self.cx, self.cy)) / (self.fx, self.fy)
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
        last = MAX_RECTIFIED_ANGLE_RAD
        rays = np.concatenate([towards * math.sin(last), np.full((len(uv), 1), math.cos(last))], 1)
        return np.asarray(np.isfinite(self.project(rays)).all(1))

    def _border(self) -> FloatArray:
        """Return the pixels where the distortion must be invertible: the border, or the middle of its four sides."""
        right, bottom = self.width - 1.0, self.height - 1.0
        if not self.corners_matter:
            x, y = 0.5 * right, 0.5 * bottom
            return np.array([[x, 0.0], [x, bottom], [0.0, y], [right, y]])
        along = np.linspace(0.0, 1.0, 33)
        zero, one = np.zeros_like(along), np.ones_like(along)
        u, v = np.concatenate([along, along, zero, one]), np.concatenate([zero, one, along, along])
        return np.stack([u * right, v * bottom], 1)


def plane(p_cam: FloatArray) -> FloatArray:
    """Return (x / z, y / z), NaN where z is not positive."""
    return p_cam[:, :2] / np.where(p_cam[:, 2] > 0, p_cam[:, 2], np.nan)[:, None]


def lift(xy: FloatArray) -> FloatArray:
    """Return (x, y, 1)."""
    return np.concatenate([xy, np.ones((len(xy), 1))], 1)


def rectify(features: Features, camera: Camera, model_sigma_px: float) -> Features:
    """Move features to the camera's pinhole equivalent; those that it cannot hold are dropped."""
    uv_rect_px, magnification = camera.rectify(features.uv_px)
    sigma_px = rectified_sigma(features.sigma_px, magnification, model_sigma_px)
    rectified = replace(features, uv_rect_px=uv_rect_px, sigma_px=sigma_px)
    inside = np.isfinite(uv_rect_px).all(axis=1) & np.isfinite(magnification)
    return rectified if inside.all() else rectified.take(inside)


def rectified_sigma(sigma_px: FloatArray, magnification: FloatArray, model_sigma_px: float) -> FloatArray:
    """Return the noise (N,) of rectified pixels, in eighths of an octave: the graph shares one noise model by sigma."""
    return np.asarray(2.0 ** (np.rint(8.0 * np.log2(np.hypot(sigma_px, model_sigma_px) * magnification)) / 8.0))
