"""From a frame to its view: the first steps of a frame's walk, in their order."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dualslam.core.camera.base import Camera, rectify
from dualslam.core.grey_image import GreyImage
from dualslam.core.interfaces import Frontend, Shutter
from dualslam.core.types import Failure, FailureReason, Frame, LateFrame, View
from dualslam.frontends.features.images import checked, to_grey
from dualslam.frontends.scene_mask import Cover, SceneMask


class FrameReader:
    """Finds the features of live frames, as an ideal camera would have seen them.

    - `camera`: returns the camera as it is known now: self-calibration may change it between two frames.
    - `model_sigma_px`: error of the camera model itself, see `CameraConfig.model_sigma_px`.
    - `scene`: which pixels show the scene.
    """

    def __init__(
        self,
        frontend: Frontend,
        camera: Callable[[], Camera],
        model_sigma_px: float,
        shutter: Shutter,
        scene: SceneMask,
    ) -> None:
        self._frontend, self._camera, self._shutter, self._scene = frontend, camera, shutter, scene
        self._model_sigma_px = model_sigma_px

    def __call__(self, frame: Frame) -> View | Failure:
        """Return the frame's view; a failure where there is no image, or one of another size."""
        camera = self._camera()
        if (unusable := _unusable(frame, camera)) is not None:
            return unusable
        # 1. Which pixels show the scene.
        self._scene.look(frame)
        cover = self._scene.cover_of(frame)
        # 2. Features of these (in real time found in the background), and 3. the lens taken out of their pixels.
        view = view_of(frame, self._frontend, camera, self._model_sigma_px, cover)
        # 4. The rows' times taken out, where the shutter is known to roll.
        return view if isinstance(view, Failure) else self._shutter.shutter_corrected(view, camera)

    def keep(self, frame: Frame) -> LateFrame | Failure:
        """Return what is kept of a frame that came too late to be tracked: its image; a failure as above."""
        image = _scene_in(frame, self._camera(), self._scene.cover_of(frame))
        if isinstance(image, Failure):
            return image
        return LateFrame(frame.index, frame.timestamp_s, GreyImage.of(to_grey(image)))


def view_of(
    frame: Frame, frontend: Frontend, camera: Camera, model_sigma_px: float, cover: Cover | None = None
) -> View | Failure:
    """Find a frame's features and take the lens distortion out of them; `cover` hides parts of its image."""
    image = _scene_in(frame, camera, cover)
    if isinstance(image, Failure):
        return image
    found = checked(frontend, frontend.extract(image) if frame.features is None else frame.features)
    if cover is not None:
        found = found.take(cover.shows(found))
    features = rectify(found, camera, model_sigma_px)
    return View(frame.index, frame.timestamp_s, features, GreyImage.of(to_grey(image)))


def _scene_in(frame: Frame, camera: Camera, cover: Cover | None) -> NDArray[np.uint8] | Failure:
    """Return a frame's image without what is covered."""
    if (unusable := _unusable(frame, camera)) is not None:
        return unusable
    assert frame.image is not None, "an image that is missing is unusable"
    return frame.image if cover is None else cover.paint(frame.image)


def _unusable(frame: Frame, camera: Camera) -> Failure | None:
    """Return why a frame has no view: it has no image, or one of another size."""
    if frame.image is None:
        return Failure(FailureReason.UNREADABLE, frame.error)
    height, width = frame.image.shape[:2]
    if (width, height) != camera.size_px:
        return Failure(
            FailureReason.UNREADABLE,
            f"frame {frame.index} is {width}x{height}, the calibration is for {camera.width}x{camera.height}",
        )
    return None
