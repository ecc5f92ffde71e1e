"""A camera with a small correction after its own rectification: what self-calibration finds."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from dualslam.core.camera.base import Camera, lift, plane
from dualslam.core.camera.models import camera_from_dict
from dualslam.core.errors import InputError
from dualslam.core.geometry import distortion
from dualslam.core.types import FloatArray


@dataclass(frozen=True, slots=True)
class LensCorrection:
    """How a camera differs from the calibration that was given.

    A ray (x, y, 1) is seen, in the given camera's rectified pixels, at ``K diag(e^a, e^a, 1) (x_d, y_d, 1)`` plus (du,
    dv). Here ``(x_d, y_d) = (x, y) (1 + k1 r^2 + k2 r^4)``.
    """

    log_focal: float = 0.0  # a, of both focal lengths
    # Of the principal point.
    du_px: float = 0.0
    dv_px: float = 0.0
    # Radial distortion that the given model has left.
    k1: float = 0.0
    k2: float = 0.0

    @property
    def vector(self) -> FloatArray:
        """(5,) in the order of the attributes."""
        return np.array(dataclasses.astuple(self))

    @classmethod
    def of_vector(cls, vector: FloatArray) -> LensCorrection:
        """Return the correction whose `vector` this is."""
        return cls(*(float(v) for v in vector))

    def intrinsics(self, K: FloatArray) -> FloatArray:
        """Return the (3, 3) intrinsics of the corrected camera, given those of the camera that was given."""
        zoom = math.exp(self.log_focal)
        corrected = K.copy()
        corrected[0, 0] *= zoom
        corrected[1, 1] *= zoom
        corrected[0, 2] += self.du_px
        corrected[1, 2] += self.dv_px
        return corrected

    def distort_px(self, K: FloatArray, xy: FloatArray) -> FloatArray:
        """Return where rays (x, y, 1) of an (N, 2) array are seen, in the given camera's rectified pixels (N, 2)."""
        moved = self.intrinsics(K)
        bent = distortion.distort_radtan(xy, (self.k1, self.k2), 0.0, 0.0)
        return np.asarray(bent * (moved[0, 0], moved[1, 1]) + moved[:2, 2], np.float64)


@dataclass(frozen=True)
class LayeredCamera(Camera):
    """A camera upon another one, whose image it has: `width` to `cy` are those of `base`."""

    base: Camera = None  # type: ignore[assignment]  # dataclass inheritance wants a default

    @classmethod
    def over(cls, base: Camera, *layer: Any) -> Self:
        """Put a layer, the fields of the class itself, upon a camera."""
        return cls(base.width, base.height, base.fx, base.fy, base.cx, base.cy, base, *layer)


@dataclass(frozen=True)
class CorrectedCamera(LayeredCamera):
    """A camera whose rectified pixels are those of another, corrected. Made by `correct`."""

    model: ClassVar[str] = "corrected"

    correction: LensCorrection = LensCorrection()

    @property
    def K(self) -> FloatArray:
        """(3, 3) intrinsics of the rectified pixels."""
        return self.correction.intrinsics(self.base.K)

    @property
    def corners_matter(self) -> bool:  # type: ignore[override]
        """As in the camera that was given."""
        return self.base.corners_matter

    def validate(self) -> None:
        """Check the correction: every pixel that the given camera rectifies must have a corrected one."""
        if not np.isfinite(self.correction.vector).all():
            raise InputError(f"camera: the correction is not finite: {self.correction}")
        rectified, _ = self.base.rectify(self._border())
        known = np.isfinite(rectified).all(1)
        lost = ~np.isfinite(self._correct_shutter(rectified[known])[0]).all(1)
        if lost.any():
            u, v = self._border()[known][int(np.argmax(lost))]
            raise InputError(f"camera: the correction has no inverse at pixel ({u:.0f}, {v:.0f})")

    def rectify(self, uv: Any) -> tuple[FloatArray, FloatArray]:
        """Take raw pixels to rectified ones: see `Camera.rectify`."""
        rectified, magnification = self.base.rectify(uv)
        xy, ratio = self._correct_shutter(rectified)
        K = self.K
        return xy * (K[0, 0], K[1, 1]) + K[:2, 2], magnification / np.sqrt(np.where(ratio > 0, ratio, np.nan))

    def resized(self, width: int, height: int) -> Self:
        """Return the camera of the whole image resized to `width` x `height` pixels."""
        base = self.base.resized(width, height)
        moved = dataclasses.replace(
            self.correction,
            du_px=self.correction.du_px * base.width / self.width,
            dv_px=self.correction.dv_px * base.height / self.height,
        )
        return self.over(base, moved)

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and names, for YAML or JSON."""
        return {"model": self.model, "base": self.base.to_dict(), "correction": dataclasses.asdict(self.correction)}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Return the camera of what `to_dict` gave."""
        try:
            base, correction = camera_from_dict(values["base"]), LensCorrection(**values["correction"])
        except (KeyError, TypeError) as error:
            raise InputError(f"camera: a corrected camera needs 'base' and 'correction': {error}") from error
        return cls.over(base, correction)

    def _correct_shutter(self, rectified: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return true normalised coordinates (N, 2) of the base's rectified pixels, and the area ratio (N,)."""
        K, k = self.K, (self.correction.k1, self.correction.k2)
        xy = distortion.undistort_radtan((rectified - K[:2, 2]) / (K[0, 0], K[1, 1]), k, 0.0, 0.0)
        J = distortion.radtan_jacobian(xy, k, 0.0, 0.0)
        return xy, np.asarray(J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0], np.float64)

    def _distort(self, p_cam: FloatArray) -> FloatArray:
        xy = distortion.within_limit(plane(p_cam), (self.correction.k1, self.correction.k2))
        base = self.base.K
        return self.base._distort(lift((self.correction.distort_px(base, xy) - base[:2, 2]) / (base[0, 0], base[1, 1])))

    def _undistort(self, xy_distorted: FloatArray) -> FloatArray:
        base, xy = self.base.K, plane(self.base._undistort(xy_distorted))
        return lift(self._correct_shutter(xy * (base[0, 0], base[1, 1]) + base[:2, 2])[0])

    def _area_ratio(self, xy: FloatArray) -> FloatArray:
        raise NotImplementedError("a corrected camera overrides rectify(), which is all that would ask")


def correct(camera: Camera, correction: LensCorrection) -> CorrectedCamera:
    """Return `camera` with a correction to the calibration that was given (one that it has already is replaced).

    Raises `InputError` if the correction has no inverse somewhere in the image.
    """
    return CorrectedCamera.over(given_camera(camera), correction)


def given_camera(camera: Camera) -> Camera:
    """Return the camera without its correction, if it has one."""
    return camera.base if isinstance(camera, CorrectedCamera) else camera


def correction_of(camera: Camera) -> LensCorrection:
    """Return the correction that a camera has: none, unless it is a `CorrectedCamera`."""
    return camera.correction if isinstance(camera, CorrectedCamera) else LensCorrection()
