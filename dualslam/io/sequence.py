"""A recorded sequence: what every format is opened as, and how its frames are read."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.camera.focal import ToldFocal
from dualslam.core.errors import InputError
from dualslam.core.interfaces import Sequence
from dualslam.core.types import BoolArray, FloatArray, Frame, IntArray
from dualslam.io.decoding import UnreadableImageError
from dualslam.io.images import ImageReader, ImageStore
from dualslam.io.read_ahead import read_ahead
from dualslam.io.times import NOMINAL_RATE_HZ
from dualslam.io.trajectory_files import Trajectory

log = logging.getLogger(__name__)

READ_AHEAD_FRAMES = 8
MAX_ROUNDING_PX = 2.0
"""By which images that were scaled may miss the shape of their calibration: sizes are whole, and often even."""


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Result of a format's reader: everything about a recorded sequence, no image read yet."""

    name: str
    images: ImageStore
    timestamps_s: FloatArray  # (N,): one for each image, ascending
    camera: Camera | None
    """None where the source brings no calibration (`open_sequence` then needs one from the caller)."""
    ground_truth: Trajectory | None = None
    exposure_s: FloatArray | None = None  # (N,)
    calibration: str = ""  # where the camera is from, for messages
    clock: str = ""  # where the times are from, for messages; empty where they are sure to be seconds


@dataclass(frozen=True, slots=True, eq=False)
class Given:
    """Data that the caller supplies instead of the source."""

    camera: bool = False  # a camera file or a field of view was given
    rate_hz: float | None = None  # frames a second of a source that has no times, or none that are right
    topic: str | None = None  # of the images, where the source is a bag


@dataclass(frozen=True, slots=True)
class Selection:
    """Which frames of a source to read: first `start`, `stride` and `max_frames`, then the direction."""

    start: int = 0
    stride: int = 1
    max_frames: int | None = None
    reverse: bool = False

    def __post_init__(self) -> None:
        """Refuse numbers that select nothing."""
        for name in ("start", "stride", "max_frames"):
            value = getattr(self, name)
            if value is not None and not isinstance(value, int | np.integer):
                raise InputError(f"{name} is {value!r}; it must be a whole number.")
        if self.start < 0:
            raise InputError(f"start is {self.start}; it counts frames from 0.")
        if self.stride < 1:
            raise InputError(f"stride is {self.stride}; it must be at least 1 (to read backwards, use reverse).")
        if self.max_frames is not None and self.max_frames < 1:
            raise InputError(f"max_frames is {self.max_frames}; it must be at least 1.")

    def indices(self, n: int, name: str) -> IntArray:
        """Return the source indices in reading order, of `n` frames."""
        if self.start >= n:
            raise InputError(f"start is {self.start}, but {name} has {n} frames; start before its end.")
        index = np.arange(self.start, n, self.stride)[: self.max_frames]
        return index[::-1].copy() if self.reverse else index


class RecordedSequence:
    """Frames of a recording, in either direction of time, read ahead on a thread of its own.

    Iterating again reads again. An image that cannot be read, or differs in size from the camera's, gives a frame with
    ``image=None`` and an `error`. Reading goes on. The log has the first of these frames, and their number where the
    reading ends.

    - `rate_hz`: frames a second as they are read, so the stride counts.
    - `ground_truth`: all that the source has, whatever the selection.
    - `source_indices` (M,) int64: index in the source of each frame that is read, in reading order.
    - `frame_timestamps` (M,) float64: the same frames' times, descending where `reverse`.
    - `source_timestamps` (N,) float64: times of all frames of the source.
    - `exposure_s` (M,) float64 or None: exposure times, where the source has them.
    - `source`: what it was opened from, by which it can be opened again; empty if that is not known.
    - `calibration`: where the camera is from, for a person.
    """

    def __init__(
        self,
        recording: Recording,
        camera: Camera,
        selection: Selection | None = None,
        *,
        grey: bool = True,
        source: str = "",
        calibration: str = "",
    ) -> None:
        self._recording = recording
        self.source, self.calibration = source, calibration
        self._grey = grey
        self.name = recording.name
        self.camera = camera
        self.ground_truth = recording.ground_truth
        self.source_timestamps = recording.timestamps_s
        self.selection = selection or Selection()
        self.source_indices = self.selection.indices(len(recording.images), recording.name)
        self.frame_timestamps = recording.timestamps_s[self.source_indices]
        self.exposure_s = None if recording.exposure_s is None else recording.exposure_s[self.source_indices]
        steps_s = np.abs(np.diff(self.frame_timestamps))
        self.rate_hz = float(1.0 / np.median(steps_s)) if len(steps_s) else NOMINAL_RATE_HZ

    def with_camera(self, camera: Camera) -> RecordedSequence:
        """Return the same frames as those of another camera, of images of the same size."""
        return RecordedSequence(self._recording, camera, self.selection, grey=self._grey, source=self.source)

    def told_focal(self) -> ToldFocal | None:
        """Return the focal length that the source's own data tell, or None."""
        return self._recording.images.told_focal()

    @property
    def image_names(self) -> tuple[str, ...] | None:
        """Return the names, without suffix, of the files of all frames of the source; None where it has no such."""
        names: tuple[str, ...] | list[str] | None = getattr(self._recording.images, "names", None)
        return None if names is None else tuple(Path(name).stem for name in names)

    @property
    def topic(self) -> str | None:
        """Return the topic of a bag that is read; None of any other source."""
        name: str | None = getattr(self._recording.images, "topic_name", None)
        return name

    def __len__(self) -> int:
        return len(self.source_indices)

    def __iter__(self) -> Iterator[Frame]:
        return read_ahead(self._read(), READ_AHEAD_FRAMES)

    def in_colour(self, indices: Iterable[int]) -> Iterator[Frame]:
        """Read some frames in colour, by their index in the source, ascending; nothing else is decoded of files."""
        reader = self._recording.images.reader(grey=False)
        try:
            for index in sorted(indices):
                if index < len(self.source_timestamps):
                    yield self._frame(reader, index, float(self.source_timestamps[index]))
        finally:
            reader.close()

    def _read(self) -> Iterator[Frame]:
        reader = self._recording.images.reader(self._grey)
        n_read = n_unreadable = 0
        try:
            for index, timestamp_s in zip(self.source_indices.tolist(), self.frame_timestamps.tolist(), strict=True):
                frame = self._frame(reader, index, timestamp_s)
                n_read += 1
                if frame.image is None:
                    n_unreadable += 1
                    log.log(logging.INFO if n_unreadable > 1 else logging.WARNING, "frame %d: %s", index, frame.error)
                yield frame
        finally:
            reader.close()
            if n_unreadable > 1:
                log.warning("%s: %d of the %d images that were read are unusable", self.name, n_unreadable, n_read)

    def _frame(self, reader: ImageReader, index: int, timestamp_s: float) -> Frame:
        try:
            image = reader.read(index)
        except UnreadableImageError as e:
            return Frame(index, timestamp_s, None, str(e))
        height, width = image.shape[:2]
        if (width, height) != self.camera.size_px:
            error = (
                f"image {index} of {self.name} is {width} x {height} pixels, "
                f"the camera {self.camera.width} x {self.camera.height}."
            )
            return Frame(index, timestamp_s, None, error)
        return Frame(index, timestamp_s, image)


def image_size(images: ImageStore, name: str, wanted: tuple[int, int] | None = None) -> tuple[int, int]:
    """Return (width, height) of a sequence's images.

    Looks at a few images, so that a single odd one does no harm: if one is of the `wanted` size that is the answer,
    otherwise the size of most of them.

    Raises `InputError` if none of all the images can be read.
    """
    n = len(images)
    few = list(dict.fromkeys(np.linspace(0, n - 1, min(n, 5)).astype(int).tolist()))
    sizes: list[tuple[int, int]] = []
    why = ""
    reader = images.reader(grey=True)
    try:
        # Beyond the few, only until one image can be read at all.
        for i in [*few, *(i for i in range(n) if i not in few)]:
            if sizes and i not in few:
                break
            try:
                height, width = reader.read(i).shape[:2]
            except UnreadableImageError as e:
                log.info("looking for the image size: %s", e)
                why = why or str(e)
                continue
            if (width, height) == wanted:
                return width, height
            sizes.append((width, height))
    finally:
        reader.close()
    if not sizes:
        raise InputError(f"{name}: none of its {n} images can be read, as {why} Check the files.")
    return Counter(sizes).most_common(1)[0][0]


def camera_of_size(camera: Camera, size_px: tuple[int, int], name: str, calibration: str) -> Camera:
    """Return a calibration for images of this size: scaled if it is for another size of the same shape.

    Raises `InputError` if the shape is another one: it cannot be known what was cut off.
    """
    if camera.size_px == size_px:
        return camera
    (width, height), was = size_px, f"{camera.width} x {camera.height}"
    scale = max(size_px) / max(camera.size_px)
    if scale == 1.0 or max(abs(camera.width * scale - width), abs(camera.height * scale - height)) > MAX_ROUNDING_PX:
        raise InputError(
            f"{calibration} is for images of {was} pixels, but those of {name} are "
            f"{width} x {height}, of another shape; give the calibration of these images."
        )
    log.warning("%s is for images of %s pixels: scaled to those of %s, %d x %d", calibration, was, name, width, height)
    return camera.resized(width, height)


class ChangedFrames:
    """Frames of another sequence, changed where they have an image.

    - `change`: returns a frame as it is to be.
    - `camera`: of the changed images, if it is another one.
    - `hidden` (H, W) bool or None: the mask of all frames, if there is one.
    """

    def __init__(
        self,
        sequence: Sequence,
        change: Callable[[Frame], Frame],
        camera: Camera | None = None,
        hidden: BoolArray | None = None,
    ) -> None:
        self._sequence, self._change = sequence, change
        self.name, self.rate_hz = sequence.name, sequence.rate_hz
        self.camera = camera or sequence.camera
        if hidden is not None:
            self.hidden = hidden

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._sequence, name)

    def __len__(self) -> int:
        return len(self._sequence)

    def __iter__(self) -> Iterator[Frame]:
        frames: Any = iter(self._sequence)
        with closing(frames) if hasattr(frames, "close") else nullcontext():
            for frame in frames:
                yield frame if frame.image is None else self._change(frame)
