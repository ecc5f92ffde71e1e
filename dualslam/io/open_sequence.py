"""One door for every kind of source: look at what was given, open it as what it is."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.camera.models import camera_from_fov
from dualslam.core.errors import InputError, NoCalibrationError, check_exists
from dualslam.io import bags, euroc, folder, kitti, tum_mono, tum_rgbd, video
from dualslam.io.camera_build import make_camera
from dualslam.io.camera_files import read_camera_file
from dualslam.io.reduced import MAX_SIDE_PX, ReducedImages, reduced_camera, reduction
from dualslam.io.sequence import Given, RecordedSequence, Recording, Selection, camera_of_size, image_size
from dualslam.io.times import UNITS, epoch_unit, in_seconds
from dualslam.io.trajectory_files import MAX_BEGIN_GAP_S
from dualslam.io.video import WebcamSequence

log = logging.getLogger(__name__)


class SourceFormat(Protocol):
    """Interface of a module that reads a folder format."""

    def recognises(self, folder: Path) -> bool:
        """Tell whether a folder is of this format, without reading much."""
        ...

    def open_recording(self, folder: Path, given: Given) -> Recording:
        """Open it, or raise `InputError` with what is wrong with it."""
        ...


NOT_READ = frozenset({".avif", ".cr2", ".dng", ".exr", ".gif", ".heic", ".heif", ".jxl", ".nef"})
"""Images that no reader of ours opens, by how their files end."""

# The surer the sign, the earlier; the plain folder of images takes what no other does.
FORMATS: tuple[SourceFormat, ...] = (bags, euroc, tum_rgbd, kitti, tum_mono, folder)


def open_sequence(
    source: str | Path | int,
    *,
    camera_file: str | Path | None = None,
    fov_degrees: float | None = None,
    start: int = 0,
    stride: int = 1,
    max_frames: int | None = None,
    reverse: bool = False,
    rate_hz: float | None = None,
    time_unit: str | None = None,
    topic: str | None = None,
    grey: bool = True,
    max_side_px: int | None = MAX_SIDE_PX,
) -> RecordedSequence | WebcamSequence:
    """Open a source of frames, whatever it is.

    - `source`: a video, a folder of images, or one of a known layout (ours, KITTI odometry, TUM RGB-D, TUM-Mono,
      EuRoC). ``0``, ``1``, ... for a webcam, or the address of a stream (``rtsp://``, ``http://``).
    - `camera_file`: calibration to use instead of the source's own (see `dualslam.io.camera_files`).
    - `fov_degrees`: field of view along the longer side of the images, where there is no calibration at all.
    - `start`, `stride`, `max_frames`: which frames: counted in the source, from `start`, every `stride`-th, at most
      `max_frames`.
    - `reverse`: read the same frames last to first. Their indices and timestamps stay what they are.
    - `rate_hz`: frames a second, instead of the source's own times.
    - `time_unit`: of the source's own times. Where it is not given they must make the rate of a camera as seconds.
    - `topic`: of the images of a bag that has several.
    - `grey`: decode to (H, W) grey; otherwise (H, W, 3) RGB.
    - `max_side_px`: larger recorded images are read smaller, by a whole factor, and their camera with them; None:
      never.

    Raises `InputError` if the source is nothing that can be read, or its parts do not fit together.
    """
    if camera_file is not None and fov_degrees is not None:
        raise InputError("A camera file and a field of view were both given; give one of them.")
    if rate_hz is not None and not 0 < rate_hz < float("inf"):
        raise InputError(f"The frame rate is {rate_hz} Hz; it must be above zero.")
    selection = Selection(start, stride, max_frames, reverse)
    if time_unit is not None and time_unit not in UNITS:
        raise InputError(f"The unit of the times is {time_unit!r}; it must be one of {', '.join(UNITS)}.")
    given = Given(camera_file is not None or fov_degrees is not None, rate_hz, topic)
    if video.is_live(source):
        if time_unit is not None:
            raise InputError(f"{source} is live and has times of its own; leave out the unit of the times.")
        name = str(source)
        device = int(name) if name.isdigit() else name
        of_file = None if camera_file is None else read_camera_file(camera_file)
        return video.open_webcam(device, of_file, fov_degrees, selection, rate_hz, grey)
    if topic is not None and not bags.has_topics(Path(str(source))):
        raise InputError(f"{source} is no bag, and has no topics; leave out the topic.")
    recording = _with_clock(_open_recording(Path(str(source)), given), rate_hz, time_unit)
    camera, calibration = recording.camera, recording.calibration
    if camera_file is not None:
        calibration = str(camera_file)
        camera = read_camera_file(camera_file, lambda: image_size(recording.images, recording.name))
    if camera is None:
        camera, calibration = _camera_from_fov(recording, fov_degrees), f"a field of view of {fov_degrees:g} degrees"
    else:
        size_px = image_size(recording.images, recording.name, camera.size_px)
        camera = camera_of_size(camera, size_px, recording.name, calibration)
    if (factor := reduction(camera, max_side_px)) > 1:
        sizes, camera = camera.size_px, reduced_camera(camera, factor)
        log.warning("%s: its images of %d x %d pixels are read as %d x %d", recording.name, *sizes, *camera.size_px)
        recording = replace(recording, images=ReducedImages(recording.images, factor))
    log.info("%s: %d frames, %s", recording.name, len(recording.images), camera)
    place = str(Path(str(source)).resolve())
    return RecordedSequence(recording, camera, selection, grey=grey, source=place, calibration=calibration)


def _open_recording(source: Path, given: Given) -> Recording:
    check_exists(source)
    if not source.is_file() and not source.is_dir():
        raise InputError(f"{source} is neither a file nor a folder (a pipe?); give one, or the address of a stream.")
    if source.is_file() and bags.is_bag_file(source):
        return bags.open_recording(source, given)
    if source.is_file():
        return video.open_recording(source)
    for known in FORMATS:
        if known.recognises(source):
            log.debug("%s: read as %s", source, known)
            return known.open_recording(source, given)
    others = sorted({p.suffix.lower() for p in source.iterdir()} & NOT_READ)
    if others:
        raise InputError(
            f"{source} holds {' and '.join(others)} files, which are not read; convert them to PNG or JPEG."
        )
    raise InputError(
        f"{source} is no sequence that can be read: it holds neither images nor a layout of ours, KITTI odometry, "
        "TUM RGB-D, TUM-Mono or EuRoC; check the path."
    )


def _with_clock(recording: Recording, rate_hz: float | None, unit: str | None) -> Recording:
    """Return a recording with times in seconds; refuse ground truth that no frame could be held against."""
    truth = recording.ground_truth
    if rate_hz is not None:
        if truth is not None:
            log.warning("%s: its ground truth is left out, as its frames are timed by their rate", recording.name)
        times_s = np.arange(len(recording.images)) / rate_hz
        return replace(recording, timestamps_s=times_s, ground_truth=None)
    if recording.clock or unit is not None:
        times_s = in_seconds(recording.timestamps_s, recording.clock or recording.name, unit)
        if truth is not None and (epoch := epoch_unit(truth.timestamps_s[0])) is not None:
            truth = replace(truth, timestamps_s=truth.timestamps_s * UNITS[epoch])
        recording = replace(recording, timestamps_s=times_s, ground_truth=truth)
    if truth is None:
        return recording
    begin_s, truth_s = recording.timestamps_s[0], truth.timestamps_s[0]
    if abs(truth_s - begin_s) > MAX_BEGIN_GAP_S:
        raise InputError(
            f"{recording.name}: its frames begin at {begin_s:.1f} s and its ground truth at {truth_s:.1f} s, "
            "which are different clocks; give both in the same seconds, or take the ground truth away."
        )
    return recording


def _camera_from_fov(recording: Recording, fov_degrees: float | None) -> Camera:
    if fov_degrees is None:
        raise NoCalibrationError(
            f"{recording.name} has no calibration; give a camera file, or a field of view in degrees (--camera, --fov)."
        )
    width, height = image_size(recording.images, recording.name)
    if height > width:
        log.warning("%s is upright: the field of view is that of its longer side, %d pixels", recording.name, height)
    return make_camera("the field of view", lambda: camera_from_fov(width, height, fov_degrees))
