"""Images in another size: large ones read smaller by whole factors, and frames resized to those of a saved map."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.camera.base import Camera
from dualslam.core.camera.focal import ToldFocal
from dualslam.core.interfaces import Sequence
from dualslam.core.types import Frame
from dualslam.io.decoding import UnreadableImageError
from dualslam.io.images import ImageReader, ImageStore
from dualslam.io.sequence import ChangedFrames

MAX_SIDE_PX = 2048
"""Longer side of images that are read as they are. A frame has a thousand features whatever its size: an image of
3840 x 2160 pixels costs time and memory above all."""


def reduction(camera: Camera, max_side_px: int | None) -> int:
    """Return the least whole factor by which a camera's images fit; 1 without a limit."""
    if max_side_px is None:
        return 1
    side, factor = max(camera.width, camera.height), 1
    while side // factor > max_side_px:
        factor += 1
    return factor


def reduced_camera(camera: Camera, factor: int) -> Camera:
    """Return the camera of images of which `factor` x `factor` pixels became one; what is left over is cut off."""
    return replace(
        camera,
        width=camera.width // factor,
        height=camera.height // factor,
        fx=camera.fx / factor,
        fy=camera.fy / factor,
        cx=(camera.cx + 0.5) / factor - 0.5,
        cy=(camera.cy + 0.5) / factor - 0.5,
    )


class ReducedImages:
    """The images of another store, smaller."""

    def __init__(self, images: ImageStore, factor: int) -> None:
        self._images, self._factor = images, factor
        self.names: tuple[str, ...] | None = getattr(images, "names", None)
        self.topic_name: str | None = getattr(images, "topic_name", None)

    def __len__(self) -> int:
        return len(self._images)

    def reader(self, grey: bool) -> ImageReader:
        """Return a reader of these images."""
        return _ReducedReader(self._images.reader(grey), self._factor)

    def told_focal(self) -> ToldFocal | None:
        """Return the focal length known of the large images: a share of their side."""
        return self._images.told_focal()


class _ReducedReader:
    def __init__(self, reader: ImageReader, factor: int) -> None:
        self._reader, self._factor = reader, factor

    def read(self, index: int) -> NDArray[np.uint8]:
        image, n = self._reader.read(index), self._factor
        height, width = image.shape[0] // n, image.shape[1] // n
        if not height or not width:
            raise UnreadableImageError(
                f"image {index} is {image.shape[1]} x {image.shape[0]} pixels: none is left where {n} x {n} become one."
            )
        whole = image[: height * n, : width * n]
        return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)

    def close(self) -> None:
        self._reader.close()


def resized_frames(sequence: Sequence, size_px: tuple[int, int]) -> Sequence:
    """Return a sequence with its images, whole, in another size (width, height)."""
    camera = sequence.camera.resized(*size_px)

    def resized(frame: Frame) -> Frame:
        assert frame.image is not None
        shrinks = frame.image.shape[1] > camera.width
        interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
        image = cv2.resize(frame.image, camera.size_px, interpolation=interpolation)
        return replace(frame, image=np.asarray(image, np.uint8))

    return ChangedFrames(sequence, resized, camera)
