"""Camera models: pinhole, radial-tangential, Kannala-Brandt, field-of-view, division, and those of sphere.py."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from dualslam.core.camera.base import Camera, lift, plane
from dualslam.core.camera.sphere import DoubleSphereCamera, EucmCamera, OmniCamera
from dualslam.core.errors import InputError
from dualslam.core.geometry import distortion
from dualslam.core.types import FloatArray


@dataclass(frozen=True)
class PinholeCamera(Camera):
    """A camera without distortion: rectified pixels are its pixels."""

    model: ClassVar[str] = "pinhole"

    def unrectify(self, uv_rect: FloatArray) -> FloatArray:
        """Return the pixels themselves: see `Camera.unrectify`."""
        return uv_rect

    def _distort(self, p_cam: FloatArray) -> FloatArray:
        return plane(p_cam)

    def _undistort(self, xy_distorted: FloatArray) -> FloatArray:
        return lift(xy_distorted)

    def _area_ratio(self, xy: FloatArray) -> FloatArray:
        return np.ones(len(xy)) + 0.0 * xy[:, 0]


@dataclass(frozen=True)
class RadTanCamera(Camera):
    """Brown's radial-tangential model, as OpenCV has it ("plumb bob")."""

    model: ClassVar[str] = "radtan"

    # In OpenCV's order. Points beyond the radius where the polynomial turns back are not imaged.
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @property
    def _k(self) -> tuple[float, ...]:
        return self.k1, self.k2, self.k3

    def _distort(self, p_cam: FloatArray) -> FloatArray:
        xy = distortion.within_limit(plane(p_cam), self._k)
        return distortion.distort_radtan(xy, self._k, self.p1, self.p2)

    def _undistort(self, xy_distorted: FloatArray) -> FloatArray:
        return lift(distortion.undistort_radtan(xy_distorted, self._k, self.p1, self.p2))

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
    """The field-of-view model of Devernay and Faugeras (2001), as TUM-Mono and DSO use it."""

    model: ClassVar[str] = "fov"

    omega: float = 1.0  # radians: distorted radius = atan(2 tan(omega / 2) r) / omega

    @classmethod
    def from_tum_mono(cls, fx: float, fy: float, cx: float, cy: float, omega: float, width: int, height: int) -> Camera:
        """Return the camera of a TUM-Mono ``camera.txt``.

        If cx and cy are below 1, the first four are relative to the image's size. The principal point then counts from
        the corner of the top-left pixel: ``cx * width - 0.5`` here. An omega of 0 means no distortion.
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
    """The division model of Fitzgibbon (2001), of one number: found where nothing is known of a lens."""

    model: ClassVar[str] = "division"

    k: float = 0.0
    """Undistorted radius = r / (1 + k r^2) of the distorted one, on the normalised plane; a barrel's is negative."""

    def _distort(self, p_cam: FloatArray) -> FloatArray:
        xy = plane(p_cam)
        root2 = 1.0 - 4.0 * self.k * (xy * xy).sum(1)
        root = np.sqrt(np.where(root2 > 0.0, root2, np.nan))
        return xy * (2.0 / (1.0 + root))[:, None]

    def _undistort(self, xy_distorted: FloatArray) -> FloatArray:
        inside = np.abs(self.k * (xy_distorted * xy_distorted).sum(1)) < 1.0
        return lift(distortion.undistort_division(np.where(inside[:, None], xy_distorted, np.nan), self.k))

    def _area_ratio(self, xy: FloatArray) -> FloatArray:
        return distortion.division_area_ratio(self._distort(lift(xy)), self.k)


_SPHERES = (OmniCamera, EucmCamera, DoubleSphereCamera)
MODELS: dict[str, type[Camera]] = {
    c.model: c for c in (PinholeCamera, RadTanCamera, KannalaBrandtCamera, FovCamera, DivisionCamera, *_SPHERES)
}


def camera_from_dict(values: Mapping[str, Any]) -> Camera:
    """Return the camera that `Camera.to_dict` described.

    Raises `InputError`: names the field that is missing, unknown or senseless.
    """
    from dualslam.core.camera.corrected import CorrectedCamera  # they stand on this module
    from dualslam.core.camera.mapped import MappedCamera

    name = values.get("model")
    if name == MappedCamera.model:
        return MappedCamera.from_dict(values)
    if name == CorrectedCamera.model:
        return CorrectedCamera.from_dict(values)
    if not isinstance(name, str) or name not in MODELS:
        raise InputError(f"camera: field 'model' is {name!r}, it must be one of {', '.join(MODELS)}")
    return MODELS[name].from_dict(values)


def camera_from_fov(width: int, height: int, degrees: float) -> PinholeCamera:
    """Return a pinhole camera with a field of view along its longer side, and its principal point in the middle.

    The longer side, as that is what makers of cameras tell, however a telephone is held.
    """
    if not isinstance(degrees, int | float | np.number) or not 0 < degrees < 180:
        raise InputError(f"camera: field of view is {degrees!r} degrees, it must be between 0 and 180")
    f = 0.5 * max(width, height) / math.tan(math.radians(0.5 * degrees))
    return PinholeCamera(width, height, f, f, 0.5 * (width - 1), 0.5 * (height - 1))
