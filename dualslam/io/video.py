"""Video files, webcams and streams, through OpenCV."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.camera.base import Camera
from dualslam.core.camera.focal import ToldFocal
from dualslam.core.camera.models import camera_from_fov
from dualslam.core.errors import InputError
from dualslam.core.types import FloatArray, Frame
from dualslam.io.camera_build import make_camera
from dualslam.io.decoding import UnreadableImageError
from dualslam.io.file_metadata import edited_s, equivalent_focal_mm, is_likely, over_longer_side
from dualslam.io.images import ImageReader
from dualslam.io.read_ahead import read_ahead
from dualslam.io.sequence import Recording, Selection, camera_of_size
from dualslam.io.times import NOMINAL_RATE_HZ, RATE

log = logging.getLogger(__name__)

# Going backwards means decoding forwards from an earlier place: this many frames at a time.
_BLOCK = 32
_LIVE_QUEUE = 2
WHOLE_SHARE = 0.95
"""Of the frames that a file announces: with fewer it was cut off. One that counts by duration and rate is a few off."""
LOG_CROP, CROP_SIGMA = 0.12, 0.08
"""By how much longer a video's focal length is than the equivalent that its container tells: the logarithm's mean and
sigma. A telephone reads a part of its sensor and keeps a rim for stabilisation: of two iPhones nothing, and 0.25."""


def open_recording(path: Path) -> Recording:
    """Open a video file: count its frames and take their presentation times (one pass without colour conversion)."""
    video = VideoFile(path)
    return Recording(path.stem, video, video.timestamps_s, camera=None)


class VideoFile:
    """The frames of a video file; `timestamps_s` (N,) float64: presentation time of each."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.timestamps_s = _scan(path)

    def __len__(self) -> int:
        return len(self.timestamps_s)

    def reader(self, grey: bool) -> ImageReader:
        """Return a reader with its own decoder."""
        return _VideoReader(self.path, self.timestamps_s, grey)

    def told_focal(self) -> ToldFocal | None:
        """Return what the container tells of the camera, which OpenCV does not read."""
        equivalent_mm = equivalent_focal_mm(self.path)
        if equivalent_mm is None:
            return None
        capture = _open(self.path)
        size_px = capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
        capture.release()
        ratio = over_longer_side(equivalent_mm, *size_px) * math.exp(LOG_CROP)
        return ToldFocal(ratio, CROP_SIGMA) if is_likely(ratio) else None


class _VideoReader:
    """Random access over a decoder that can only go forwards."""

    def __init__(self, path: Path, times_s: FloatArray, grey: bool) -> None:
        self._path, self._times_s, self._grey = path, times_s, grey
        self._capture = _open(path)
        self._next = 0
        self._block: dict[int, NDArray[np.uint8] | None] = {}

    def read(self, index: int) -> NDArray[np.uint8]:
        if index in self._block:
            image = self._block.pop(index)
        elif index >= self._next:
            self._block.clear()
            self._skip_to(index)
            image = self._decode()
        else:
            first = max(index + 1 - _BLOCK, 0)
            self._seek(first)
            self._skip_to(first)
            self._block = {i: self._decode() for i in range(first, index + 1)}
            image = self._block.pop(index)
        if image is None:
            raise UnreadableImageError(f"frame {index} of {self._path} cannot be decoded.")
        return image

    def close(self) -> None:
        self._capture.release()

    def _decode(self) -> NDArray[np.uint8] | None:
        self._next += 1
        if not self._capture.grab():
            return None
        ok, image = self._capture.retrieve()
        return convert(image, self._grey) if ok and image is not None else None

    def _skip_to(self, index: int) -> None:
        while self._next < index:
            self._capture.grab()
            self._next += 1

    def _seek(self, index: int) -> None:
        # Seeking is exact with some codecs only: the next frame's time tells, and if it is wrong, count from the start.
        if index > 0 and self._capture.set(cv2.CAP_PROP_POS_FRAMES, index - 1) and self._capture.grab():
            step = float(np.min(np.diff(self._times_s)))
            if abs(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e-3 - self._times_s[index - 1]) < 0.5 * step:
                self._next = index
                return
        self._capture.release()
        self._capture = _open(self._path)
        self._next = 0


def _open(path: Path) -> cv2.VideoCapture:
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise InputError(
            f"{path} is no video that OpenCV can open; fetch it again if its end may be missing, or convert it."
        )
    return capture


def _scan(path: Path) -> FloatArray:
    """Return the presentation time of every frame that can be decoded; the file's own count is often wrong."""
    capture = _open(path)
    fps, announced = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
    found = []
    while capture.grab():
        found.append(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e-3)
    capture.release()
    if not found:
        raise InputError(f"{path} holds no frame that can be decoded; check the file, or convert it to another codec.")
    played_s = edited_s(path)
    if played_s is not None and np.isfinite(fps):
        announced = min(announced, played_s * fps)
    if len(found) < WHOLE_SHARE * announced:
        log.warning("%s ends early: %d of the %.0f frames that it announces are there", path, len(found), announced)
    times = np.array(found)
    if np.isfinite(times).all() and (np.diff(times) > 0).all():
        return times
    if not (np.isfinite(fps) and fps > 0):
        raise InputError(f"{path} tells neither the times of its frames nor their rate; give {RATE}.")
    log.warning("%s has no usable times of its frames: they are counted at its %g Hz", path, fps)
    return np.arange(len(times)) / fps


def convert(image: NDArray[np.uint8], grey: bool) -> NDArray[np.uint8]:
    """Return a captured image (BGR, or grey already) as (H, W) grey or (H, W, 3) RGB."""
    if image.ndim == 2:
        return image if grey else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), np.uint8)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY if grey else cv2.COLOR_BGR2RGB), np.uint8)


# --- webcam


class WebcamSequence:
    """Live frames. Its length is known only where `max_frames` sets it.

    A frame that nobody took in time gives way to a newer one; `Frame.index` counts it all the same.
    """

    ground_truth = None

    def __init__(
        self,
        name: str,
        camera: Camera,
        rate_hz: float,
        selection: Selection,
        grey: bool,
        connect: Callable[[], cv2.VideoCapture],
    ) -> None:
        self.name = name
        self.camera = camera
        self.rate_hz = rate_hz / selection.stride
        self.selection = selection
        self._grey = grey
        self._connect = connect

    def __len__(self) -> int:
        if self.selection.max_frames is None:
            raise TypeError(f"{self.name} is live: it has no length")
        return self.selection.max_frames

    def __iter__(self) -> Iterator[Frame]:
        return read_ahead(self._capture_frames(), _LIVE_QUEUE, drop_oldest=self.selection.max_frames is None)

    def _capture_frames(self) -> Iterator[Frame]:
        wanted = self.selection
        capture = self._connect()
        # Time of day at the start, then a clock that never steps back.
        epoch_s = time.time() - time.monotonic()
        taken = 0
        try:
            for index in count():
                if not capture.grab():
                    raise InputError(
                        f"{self.name} stopped giving frames; check that it is plugged in or can be reached."
                    )
                timestamp_s = epoch_s + time.monotonic()
                if index < wanted.start or (index - wanted.start) % wanted.stride:
                    continue
                ok, image = capture.retrieve()
                if ok and image is not None:
                    yield Frame(index, timestamp_s, convert(image, self._grey))
                else:
                    yield Frame(index, timestamp_s, None, f"frame {index} of {self.name} could not be decoded.")
                taken += 1
                if taken == wanted.max_frames:
                    return
        finally:
            capture.release()


def is_live(source: str | Path | int) -> bool:
    """Whether a source is the number of a webcam, a device, or the address of a stream."""
    name, path = str(source), Path(str(source))
    return "://" in name or path.is_char_device() or (name.isdigit() and not path.exists())


def open_webcam(
    source: int | str,
    camera: Camera | None,
    fov_degrees: float | None,
    selection: Selection,
    rate_hz: float | None,
    grey: bool,
    connect: Callable[[Any], Any] = cv2.VideoCapture,
) -> WebcamSequence:
    """Open a webcam by its number or device, or a stream by its address.

    It is opened once to learn the size of its images, then again whenever the sequence is read.
    """
    check = "check that it is plugged in and that no one uses it"
    if isinstance(source, int):
        name, called = f"webcam_{source}", f"Webcam {source}"
    elif "://" in source:
        host = _host(source)
        name, called = f"stream_{host}", f"The stream at {host}"
        check = "check the address and that it can be reached"
    else:
        name, called = Path(source).name, source
    if selection.reverse:
        raise InputError(f"{called} is live and cannot be read in reverse.")
    if rate_hz is not None:
        raise InputError(f"{called} is live and has times of its own; leave out the rate.")
    if camera is None and fov_degrees is None:
        raise InputError(f"{called} has no calibration; give a camera file, or a field of view in degrees.")

    def connected() -> cv2.VideoCapture:
        capture: cv2.VideoCapture = connect(source)
        if not capture.isOpened():
            raise InputError(f"{called} cannot be opened; {check}.")
        return capture

    capture = connected()
    ok = capture.grab()
    image = capture.retrieve()[1] if ok else None
    fps = capture.get(cv2.CAP_PROP_FPS)
    capture.release()
    if image is None:
        raise InputError(f"{called} gives no frames; {check}.")
    height, width = image.shape[:2]
    if camera is None:
        degrees = float(fov_degrees or 0.0)
        camera = make_camera("the field of view", lambda: camera_from_fov(width, height, degrees))
    else:
        camera = camera_of_size(camera, (width, height), name, "The camera file")
    return WebcamSequence(name, camera, fps if fps > 0 else NOMINAL_RATE_HZ, selection, grey, connected)


def _host(address: str) -> str:
    """Return where a stream comes from: what else is in an address may be a password."""
    try:
        return urlsplit(address).hostname or "local"
    except ValueError:
        raise InputError("The address of the stream cannot be read; check its brackets.") from None
