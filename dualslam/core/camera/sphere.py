"""Fisheye models that project by way of a sphere: unified (omni), extended unified and double sphere; see `Camera`."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.errors import InputError
from dualslam.core.geometry import distortion
from dualslam.core.types import FloatArray


class _SphereCamera(Camera):
    """A lens that divides (x, y) of a point by a length that grows with its distance."""

    corners_matter: ClassVar[bool] = False

    @abstractmethod
    def _divisor(self, p_cam: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the divisor (N,), NaN where points are not imaged, and r times its derivative by r = |(x, y)|."""

    def _distort(self, p_cam: FloatArray) -> FloatArray:
        divisor, _ = self._divisor(p_cam)
        return np.asarray(p_cam[:, :2] / np.where(divisor > 0, divisor, np.nan)[:, None], np.float64)

    def _area_ratio(self, xy: FloatArray) -> FloatArray:
        divisor, slope = self._divisor(np.concatenate([xy, np.ones((len(xy), 1))], 1))
        return np.asarray((divisor - slope) / divisor**3, np.float64)

    def _refuse_outside(self, name: str, low: float, high: float) -> None:
        value = getattr(self, name)
        if not low <= value <= high:
            raise InputError(f"camera: {name} is {value}, it must be {low:g} to {high:g} in model '{self.model}'")


def _squares(p: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return r^2, z and the length of points (N, 3), or of (N, 2) with z = 0."""
    r2 = np.einsum("ij,ij->i", p[:, :2], p[:, :2])
    z = p[:, 2] if p.shape[1] == 3 else np.zeros(len(p))
    return r2, z, np.sqrt(r2 + z * z)


def _root(square: FloatArray) -> FloatArray:
    """Return the square root, NaN of a negative number."""
    return np.sqrt(np.where(square >= 0, square, np.nan))


@dataclass(frozen=True)
class OmniCamera(_SphereCamera):
    """Mei's unified model (2007): Kalibr's ``omni``, the ``MEI`` of VINS-Mono."""

    model: ClassVar[str] = "omni"

    xi: float = 0.0  # points are divided by z + xi |p|
    # Radial-tangential distortion after the division.
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def validate(self) -> None:
        """Check the calibration: see `Camera.validate`."""
        self._refuse_outside("xi", 0.0, 10.0)
        super().validate()

    def _centre_zoom(self) -> float:
        return 1.0 / (1.0 + self.xi)

    def _divisor(self, p_cam: FloatArray) -> tuple[FloatArray, FloatArray]:
        r2, z, d = _squares(p_cam)
        shown = z > -d * (self.xi if self.xi <= 1.0 else 1.0 / self.xi)
        return np.where(shown, z + self.xi * d, np.nan), self.xi * r2 / np.where(d > 0, d, np.nan)

    def _distort(self, p_cam: FloatArray) -> FloatArray:
        k = self.k1, self.k2
        return distortion.distort_radtan(distortion.within_limit(super()._distort(p_cam), k), k, self.p1, self.p2)

    def _undistort(self, xy_distorted: FloatArray) -> FloatArray:
        m = distortion.undistort_radtan(xy_distorted, (self.k1, self.k2), self.p1, self.p2)
        r2, _, _ = _squares(m)
        stretch = (self.xi + _root(1.0 + (1.0 - self.xi**2) * r2)) / (1.0 + r2)
        return np.concatenate([m * stretch[:, None], (stretch - self.xi)[:, None]], 1)

    def _area_ratio(self, xy: FloatArray) -> FloatArray:
        divisor, _ = self._divisor(np.concatenate([xy, np.ones((len(xy), 1))], 1))
        J = distortion.radtan_jacobian(xy / divisor[:, None], (self.k1, self.k2), self.p1, self.p2)
        return super()._area_ratio(xy) * (J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0])


@dataclass(frozen=True)
class EucmCamera(_SphereCamera):
    """The extended unified model of Khomutenko (2016): Kalibr's and Basalt's ``eucm``; with beta = 1, their ``ucm``."""

    model: ClassVar[str] = "eucm"

    # Points are divided by alpha sqrt(beta r^2 + z^2) + (1 - alpha) z.
    alpha: float = 0.0
    beta: float = 1.0

    def validate(self) -> None:
        """Check the calibration: see `Camera.validate`."""
        self._refuse_outside("alpha", 0.0, 1.0)
        self._refuse_outside("beta", 1e-3, 1e3)
        super().validate()

    def _divisor(self, p_cam: FloatArray) -> tuple[FloatArray, FloatArray]:
        a = self.alpha
        r2, z, _ = _squares(p_cam)
        d = np.sqrt(self.beta * r2 + z * z)
        shown = z > -d * (a / (1.0 - a) if a <= 0.5 else (1.0 - a) / a)
        return np.where(shown, a * d + (1.0 - a) * z, np.nan), a * self.beta * r2 / np.where(d > 0, d, np.nan)

    def _undistort(self, xy_distorted: FloatArray) -> FloatArray:
        a = self.alpha
        r2, _, _ = _squares(xy_distorted)
        z = (1.0 - self.beta * a * a * r2) / (a * _root(1.0 - (2.0 * a - 1.0) * self.beta * r2) + 1.0 - a)
        return np.concatenate([xy_distorted, z[:, None]], 1)


@dataclass(frozen=True)
class DoubleSphereCamera(_SphereCamera):
    """The double-sphere model of Usenko (2018): Kalibr's and Basalt's ``ds``."""

    model: ClassVar[str] = "double_sphere"

    # Points are divided by alpha |(x, y, s)| + (1 - alpha) s, where s = z + xi |p|.
    xi: float = 0.0
    alpha: float = 0.0

    def validate(self) -> None:
        """Check the calibration: see `Camera.validate`."""
        self._refuse_outside("xi", -0.999, 10.0)
        self._refuse_outside("alpha", 0.0, 1.0)
        super().validate()

    def _centre_zoom(self) -> float:
        return 1.0 / (1.0 + self.xi)

    def _divisor(self, p_cam: FloatArray) -> tuple[FloatArray, FloatArray]:
        xi, a = self.xi, self.alpha
        r2, z, d = _squares(p_cam)
        shifted = z + xi * d
        d2 = np.sqrt(r2 + shifted**2)
        w = a / (1.0 - a) if a <= 0.5 else (1.0 - a) / a
        shown = z > -d * (w + xi) / np.sqrt(2.0 * w * xi + xi * xi + 1.0)
        slope = xi * r2 / np.where(d > 0, d, np.nan)  # r times the derivative of `shifted` by r
        slope2 = (r2 + shifted * slope) / np.where(d2 > 0, d2, np.nan)
        return np.where(shown, a * d2 + (1.0 - a) * shifted, np.nan), a * slope2 + (1.0 - a) * slope

    def _undistort(self, xy_distorted: FloatArray) -> FloatArray:
        xi, a = self.xi, self.alpha
        r2, _, _ = _squares(xy_distorted)
        z = (1.0 - a * a * r2) / (a * _root(1.0 - (2.0 * a - 1.0) * r2) + 1.0 - a)
        stretch = (z * xi + _root(z * z + (1.0 - xi * xi) * r2)) / (z * z + r2)
        return np.concatenate([xy_distorted * stretch[:, None], (stretch * z - xi)[:, None]], 1)
