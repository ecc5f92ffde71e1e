"""A camera that looks at the map of another one: its rectified pixels are the map's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.camera.corrected import LayeredCamera, given_camera
from dualslam.core.camera.models import camera_from_dict
from dualslam.core.errors import InputError
from dualslam.core.types import FloatArray

SAME_PX = 1.0
"""Between the rays of two calibrations of one image, anywhere: less than a calibration knows, and a feature's noise."""


@dataclass(frozen=True)
class MappedCamera(LayeredCamera):
    """A camera whose rays are its own, and whose rectified pixels are those of a map. Made by `camera_for_map`."""

    model: ClassVar[str] = "mapped"

    map_K: tuple[float, float, float, float] = (1.0, 1.0, 0.0, 0.0)  # fx, fy, cx, cy of the map's rectified pixels

    @classmethod
    def of(cls, base: Camera, K: FloatArray) -> MappedCamera:
        """Bring a camera to the rectified pixels of intrinsics (3, 3)."""
        return cls.over(base, (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])))

    @property
    def K(self) -> FloatArray:
        """(3, 3) intrinsics of the map's rectified pixels."""
        fx, fy, cx, cy = self.map_K
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def validate(self) -> None:
        """Nothing: the base has been checked."""

    def project(self, p_cam: Any) -> FloatArray:
        """Return raw pixels: see `Camera.project`."""
        return self.base.project(p_cam)

    def unproject(self, uv: Any) -> FloatArray:
        """Return unit rays: see `Camera.unproject`."""
        return self.base.unproject(uv)

    def rectify(self, uv: Any) -> tuple[FloatArray, FloatArray]:
        """Take raw pixels to the map's rectified ones: see `Camera.rectify`."""
        rectified, magnification = self.base.rectify(uv)
        scale, shift = self._from_base()
        return rectified * scale + shift, magnification * np.sqrt(scale.prod())

    def unrectify(self, uv_rect: FloatArray) -> FloatArray:
        """Take the map's rectified pixels to raw ones: see `Camera.unrectify`."""
        scale, shift = self._from_base()
        return self.base.unrectify((uv_rect - shift) / scale)

    def resized(self, width: int, height: int) -> Self:
        """Return the camera of the whole image resized to `width` x `height` pixels."""
        return self.over(self.base.resized(width, height), self.map_K)

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and names, for YAML or JSON."""
        return {"model": self.model, "base": self.base.to_dict(), "map_K": list(self.map_K)}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Return the camera of what `to_dict` gave."""
        try:
            base, (fx, fy, cx, cy) = camera_from_dict(values["base"]), (float(v) for v in values["map_K"])
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"camera: a mapped camera needs 'base' and four numbers 'map_K': {error}") from error
        return cls.over(base, (fx, fy, cx, cy))

    def _from_base(self) -> tuple[FloatArray, FloatArray]:
        """Return the factors (2,) and shifts (2,) from the base's rectified pixels to the map's."""
        K, own = self.K, self.base.K
        scale = np.array([K[0, 0] / own[0, 0], K[1, 1] / own[1, 1]])
        return scale, K[:2, 2] - scale * own[:2, 2]

    def _distort(self, p_cam: FloatArray) -> FloatArray:
        return self.base._distort(p_cam)

    def _undistort(self, xy_distorted: FloatArray) -> FloatArray:
        return self.base._undistort(xy_distorted)

    def _area_ratio(self, xy: FloatArray) -> FloatArray:
        return self.base._area_ratio(xy)


def camera_for_map(known: Camera, camera: Camera) -> Camera:
    """Return the camera by which frames are found in a map.

    - `known`: of the map, with what was found out about it.
    - `camera`: as it was given, of the frames.

    Returns Camera: `known`, where both are one to less than `SAME_PX`; else `camera`, brought to the map's pixels.
    """
    if isinstance(camera, MappedCamera):
        return camera
    if is_same(own_camera(known), camera):
        return known
    return MappedCamera.of(camera, known.K)


def own_camera(camera: Camera) -> Camera:
    """Return a camera as it was given, without a correction, and without the map that it was brought to."""
    return given_camera(camera.base if isinstance(camera, MappedCamera) else camera)


def is_same(a: Camera, b: Camera) -> bool:
    """Whether two calibrations of images of one size see each pixel along the same ray, to `SAME_PX`."""
    if a.size_px != b.size_px:
        return False
    u, v = np.meshgrid(np.linspace(0, a.width - 1, 9), np.linspace(0, a.height - 1, 9))
    uv = np.stack([u.ravel(), v.ravel()], 1)
    rays = b.unproject(uv)
    back = a.project(rays)
    known, imaged = np.isfinite(back).all(1), np.isfinite(rays).all(1)
    apart = np.linalg.norm(back[known] - uv[known], axis=1)
    return bool(known.sum() > 0.5 * imaged.sum() and (apart < SAME_PX).all())
