"""Camera models. Each hides its lens: the rest of the system sees rectified pixels of a pinhole with intrinsics `K`.

Pixel (0, 0) is the centre of the top-left pixel. The camera looks along +z, x right, y down.
"""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from dualslam.core.errors import InputError
from dualslam.core.geometry import distortion
from dualslam.core.types import FloatArray

MAX_RECTIFIED_ANGLE_RAD = math.radians(80.0)
"""Rays farther from the axis have no useful place in a pinhole image: `Camera.rectify` makes them NaN."""


@dataclass(frozen=True)
class Camera(ABC):
    """A calibrated camera: raw pixels of its image, rays, and rectified pixels.

    Attributes
    ----------
    width, height : int
        Of the raw image, pixels.
    fx, fy, cx, cy : float
        Of the raw image, pixels: raw pixel = (fx x + cx, fy y + cy) for distorted normalised (x, y).
    model : str
        Name of the class in files.
    corners_matter : bool
        Whether `validate` wants an inverse in the corners of the image, or only at the middle of its sides.
    """

    model: ClassVar[str]
    corners_matter: ClassVar[bool] = True

    width: int
    height: int
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

    @property
    def K(self) -> FloatArray:
        """(3, 3) intrinsics of the rectified pixels: the pinhole camera with the same magnification on the axis."""
        zoom = self._centre_zoom()
        return np.array([[self.fx * zoom, 0.0, self.cx], [0.0, self.fy * zoom, self.cy], [0.0, 0.0, 1.0]])

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

        Parameters
        ----------
        uv : (N, 2)

        Returns
        -------
        uv_rect : (N, 2)
            Pixels of the pinhole camera `K`; NaN for rays beyond `MAX_RECTIFIED_ANGLE_RAD` or outside the model.
        magnification : (N,)
            Root of the determinant of d(uv_rect)/d(uv): a raw sigma times this is the sigma of the rectified pixel.
        """
        rays = self.unproject(uv)
        z = np.where(rays[:, 2] > math.cos(MAX_RECTIFIED_ANGLE_RAD), rays[:, 2], np.nan)
        xy = rays[:, :2] / z[:, None]
        K = self.K
        ratio = self._area_ratio(xy)
        magnification = self._centre_zoom() / np.sqrt(np.where(ratio > 0, ratio, np.nan))
        return xy * (K[0, 0], K[1, 1]) + K[:2, 2], magnification

    def scaled(self, factor: float) -> Self:
        """Return the camera of the image resized by `factor` (sizes rounded, intrinsics follow the rounded sizes)."""
        width, height = max(round(self.width * factor), 1), max(round(self.height * factor), 1)
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

        Raises
        ------
        InputError
            Names the field that is missing, unknown or not a number.
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

        Raises
        ------
        InputError
            One sentence that names the field.
        """
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not math.isfinite(value):
                raise InputError(f"camera: {field.name} is {value}, it must be finite")
        for name in ("width", "height", "fx", "fy"):
            if getattr(self, name) <= 0:
                raise InputError(f"camera: {name} is {getattr(self, name)}, it must be positive")
        for name, size in (("cx", self.width), ("cy", self.height)):
            if not -0.5 <= getattr(self, name) <= size - 0.5:
                raise InputError(f"camera: {name} is {getattr(self, name)}, outside of the image of {size} pixels")
        outside = np.isnan(self.unproject(self._border())).any(1)
        if outside.any():
            u, v = self._border()[int(np.argmax(outside))]
            raise InputError(
                f"camera: the distortion of model '{self.model}' has no inverse at pixel ({u:.0f}, {v:.0f})"
            )

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


def _plane(p_cam: FloatArray) -> FloatArray:
    """Return (x / z, y / z), NaN where z is not positive."""
    return p_cam[:, :2] / np.where(p_cam[:, 2] > 0, p_cam[:, 2], np.nan)[:, None]


def _lift(xy: FloatArray) -> FloatArray:
    """Return (x, y, 1)."""
    return np.concatenate([xy, np.ones((len(xy), 1))], 1)


@dataclass(frozen=True)
class PinholeCamera(Camera):
    """A camera without distortion: rectified pixels are its pixels."""

    model: ClassVar[str] = "pinhole"

    def _distort(self, p_cam: FloatArray) -> FloatArray:
        return _plane(p_cam)

    def _undistort(self, xy_distorted: FloatArray) -> FloatArray:
        return _lift(xy_distorted)

    def _area_ratio(self, xy: FloatArray) -> FloatArray:
        return np.ones(len(xy)) + 0.0 * xy[:, 0]


@dataclass(frozen=True)
class RadTanCamera(Camera):
    """Brown's radial-tangential model, as OpenCV has it ("plumb bob").

    Attributes
    ----------
    k1, k2, p1, p2, k3 : float
        In OpenCV's order. Points beyond the radius where the polynomial turns back are not imaged.
    """

    model: ClassVar[str] = "radtan"

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @property
    def _k(self) -> tuple[float, ...]:
        return self.k1, self.k2, self.k3

    def _distort(self, p_cam: FloatArray) -> FloatArray:
        xy = _plane(p_cam)
        r2 = (xy * xy).sum(1)
        xy = np.where((r2 < distortion.radial_limit(self._k) ** 2)[:, None], xy, np.nan)
        return distortion.distort_radtan(xy, self._k, self.p1, self.p2)

    def _undistort(self, xy_distorted: FloatArray) -> FloatArray:
        return _lift(distortion.undistort_radtan(xy_distorted, self._k, self.p1, self.p2))

    def _area_ratio(self, xy: FloatArray) -> FloatArray:
        J = distortion.radtan_jacobian(xy, self._k, self.p1, self.p2)
        return np.asarray(J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0], np.float64)


class _RadialCamera(Camera):
    """A lens that only moves points along their radius, as a function of the angle from the axis."""

    corners_matter: ClassVar[bool] = False

    @abstractmethod
    def _radius(self, theta: FloatArray) -> FloatArray:
        """Return the distorted radius of an angle from the axis, NaN outside the model."""

    @abstractmethod
    def _radius_slope(self, theta: FloatArray) -> FloatArray:
        """Return the derivative of `_radius`."""

    @abstractmethod
    def _angle(self, radius: FloatArray) -> FloatArray:
        """Return the inverse of `_radius`, NaN where it has none."""

    def _distort(self, p_cam: FloatArray) -> FloatArray:
        r = np.hypot(p_cam[:, 0], p_cam[:, 1])
        r_distorted = self._radius(np.arctan2(r, p_cam[:, 2]))
        on_axis = r == 0
        xy = p_cam[:, :2] * (r_distorted / np.where(on_axis, 1.0, r))[:, None]
        return np.where((on_axis & ~(p_cam[:, 2] > 0))[:, None], np.nan, xy)

    def _undistort(self, xy_distorted: FloatArray) -> FloatArray:
        r = np.hypot(xy_distorted[:, 0], xy_distorted[:, 1])
        theta = self._angle(r)
        factor = np.where(r > 0, np.sin(theta) / np.where(r > 0, r, 1.0), self._centre_zoom())
        return np.concatenate([xy_distorted * factor[:, None], np.cos(theta)[:, None]], 1)

    def _area_ratio(self, xy: FloatArray) -> FloatArray:
        r = np.hypot(xy[:, 0], xy[:, 1])
        theta = np.arctan(r)
        along = self._radius_slope(theta) / (1.0 + r * r)
        across = np.where(r > 1e-9, self._radius(theta) / np.where(r > 1e-9, r, 1.0), self._centre_zoom())
        return np.asarray(along * across, np.float64)


@dataclass(frozen=True)
class KannalaBrandtCamera(_RadialCamera):
    """Kannala and Brandt's fisheye, as ``cv2.fisheye`` has it: radius = theta (1 + k1 theta^2 + ... + k4 theta^8).

    Rays beyond 90 degrees from the axis are imaged too; only rectified pixels end at 80.
    """

    model: ClassVar[str] = "kannala_brandt"

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    @property
    def _k(self) -> tuple[float, ...]:
        return self.k1, self.k2, self.k3, self.k4

    @property
    def _limit(self) -> float:
        return min(distortion.radial_limit(self._k), math.pi)

    def _radius(self, theta: FloatArray) -> FloatArray:
        return np.where(theta < self._limit, distortion.radial(theta, self._k), np.nan)

    def _radius_slope(self, theta: FloatArray) -> FloatArray:
        return distortion.radial_derivative(theta, self._k)

    def _angle(self, radius: FloatArray) -> FloatArray:
        return distortion.invert_radial(radius, self._k, self._limit)


@dataclass(frozen=True)
class FovCamera(_RadialCamera):
    """The field-of-view model of Devernay and Faugeras (2001), as TUM-Mono and DSO use it.

    Attributes
    ----------
    omega : float
        Radians: distorted radius = atan(2 tan(omega / 2) r) / omega.
    """

    model: ClassVar[str] = "fov"

    omega: float = 1.0

    @classmethod
    def from_tum_mono(cls, fx: float, fy: float, cx: float, cy: float, omega: float, width: int, height: int) -> Camera:
        """Return the camera of a TUM-Mono ``camera.txt``.

        Where cx and cy are below 1, the first four are relative to the image's size and the principal point counts
        from the corner of the top-left pixel: ``cx * width - 0.5`` here. An omega of 0 means no distortion.
        """
        if cx < 1 and cy < 1:
            fx, fy, cx, cy = fx * width, fy * height, cx * width - 0.5, cy * height - 0.5
        if omega == 0:
            return PinholeCamera(width, height, fx, fy, cx, cy)
        return cls(width, height, fx, fy, cx, cy, omega)

    def validate(self) -> None:
        """Check the calibration: see `Camera.validate`."""
        if not 0 < self.omega < math.pi:
            raise InputError(f"camera: omega is {self.omega}, it must be between 0 and pi (radians)")
        super().validate()

    def _centre_zoom(self) -> float:
        return 2.0 * math.tan(0.5 * self.omega) / self.omega

    def _radius(self, theta: FloatArray) -> FloatArray:
        r = np.tan(np.where(theta < 0.5 * math.pi, theta, np.nan))
        return np.arctan(2.0 * math.tan(0.5 * self.omega) * r) / self.omega

    def _radius_slope(self, theta: FloatArray) -> FloatArray:
        r = np.tan(theta)
        k = 2.0 * math.tan(0.5 * self.omega)
        return np.asarray(k / self.omega * (1.0 + r * r) / (1.0 + k * k * r * r), np.float64)

    def _angle(self, radius: FloatArray) -> FloatArray:
        inside = radius * self.omega < 0.5 * math.pi
        angle = np.where(inside, radius * self.omega, np.nan)
        return np.arctan(np.tan(angle) / (2.0 * math.tan(0.5 * self.omega)))


@dataclass(frozen=True)
class DivisionCamera(Camera):
    """The division model of Fitzgibbon (2001), which one number says: what is found where nothing is known of a lens.

    Attributes
    ----------
    k : float
        Undistorted radius = r / (1 + k r^2) of the distorted one, on the normalised plane; a barrel's is negative.
    """

    model: ClassVar[str] = "division"

    k: float = 0.0

    def _distort(self, p_cam: FloatArray) -> FloatArray:
        xy = _plane(p_cam)
        root2 = 1.0 - 4.0 * self.k * (xy * xy).sum(1)
        root = np.sqrt(np.where(root2 > 0.0, root2, np.nan))
        return xy * (2.0 / (1.0 + root))[:, None]

    def _undistort(self, xy_distorted: FloatArray) -> FloatArray:
        inside = np.abs(self.k * (xy_distorted * xy_distorted).sum(1)) < 1.0
        return _lift(distortion.undistort_division(np.where(inside[:, None], xy_distorted, np.nan), self.k))

    def _area_ratio(self, xy: FloatArray) -> FloatArray:
        return distortion.division_area_ratio(self._distort(_lift(xy)), self.k)


MODELS: dict[str, type[Camera]] = {
    c.model: c for c in (PinholeCamera, RadTanCamera, KannalaBrandtCamera, FovCamera, DivisionCamera)
}


def camera_from_dict(values: Mapping[str, Any]) -> Camera:
    """Return the camera that `Camera.to_dict` described.

    Raises
    ------
    InputError
        Names the field that is missing, unknown or senseless.
    """
    from dualslam.core.camera.corrected import CorrectedCamera  # it stands on this module

    name = values.get("model")
    if name == CorrectedCamera.model:
        return CorrectedCamera.from_dict(values)
    if not isinstance(name, str) or name not in MODELS:
        raise InputError(f"camera: field 'model' is {name!r}, it must be one of {', '.join(MODELS)}")
    return MODELS[name].from_dict(values)


def camera_from_fov(width: int, height: int, degrees: float) -> PinholeCamera:
    """Return a pinhole camera with the given horizontal field of view and its principal point in the middle."""
    if not 0 < degrees < 180:
        raise InputError(f"camera: field of view is {degrees} degrees, it must be between 0 and 180")
    f = 0.5 * width / math.tan(math.radians(0.5 * degrees))
    return PinholeCamera(width, height, f, f, 0.5 * (width - 1), 0.5 * (height - 1))
