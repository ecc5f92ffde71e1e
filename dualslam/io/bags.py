"""ROS bags and MCAP as recordings: an image topic, and the camera of its `camera_info`."""

from __future__ import annotations

import logging
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.camera.base import Camera
from dualslam.core.errors import InputError
from dualslam.core.types import FloatArray
from dualslam.io.bag_files import Bag, BagReader, Place, Topic, is_bag, scan
from dualslam.io.camera_keys import camera_of_mapping
from dualslam.io.decoding import WHOLE, UnreadableImageError, decode, upper_eight, used_bits
from dualslam.io.images import ImageReader, natural_key
from dualslam.io.sequence import Given, Recording
from dualslam.io.times import checked_times

log = logging.getLogger(__name__)

IMAGE, COMPRESSED, INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
SUFFIXES = (".mcap", ".db3", ".bag")
TO_RGB: dict[str, int | None] = {
    **dict.fromkeys(("mono8", "8uc1", "mono16", "16uc1"), cv2.COLOR_GRAY2RGB),
    **dict.fromkeys(("rgb8", "8uc3"), None),
    "bgr8": cv2.COLOR_BGR2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB,
    "bgra8": cv2.COLOR_BGRA2RGB,
    **dict.fromkeys(("yuv422", "uyvy"), cv2.COLOR_YUV2RGB_UYVY),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), cv2.COLOR_YUV2RGB_YUYV),
    # OpenCV names a mosaic by its second row, ROS by its first.
    **{f"bayer_rggb{bits}": cv2.COLOR_BayerBG2RGB for bits in (8, 16)},
    **{f"bayer_bggr{bits}": cv2.COLOR_BayerRG2RGB for bits in (8, 16)},
    **{f"bayer_gbrg{bits}": cv2.COLOR_BayerGR2RGB for bits in (8, 16)},
    **{f"bayer_grbg{bits}": cv2.COLOR_BayerGB2RGB for bits in (8, 16)},
}
"""OpenCV's conversion of an image of one of ROS's encodings."""


def recognises(folder: Path) -> bool:
    """Tell whether `folder` is a bag of ROS 2: with its `metadata.yaml`, or of nothing but files of bags."""
    alone = all(p.suffix.lower().startswith((*SUFFIXES, ".zstd")) for p in folder.iterdir())
    return bool(files_of_bag(folder)) and (alone or (folder / "metadata.yaml").is_file())


def is_bag_file(path: Path) -> bool:
    """Tell whether a file is a bag, or is called one."""
    return path.suffix.lower() in SUFFIXES or is_bag(path)


def has_topics(path: Path) -> bool:
    """Tell whether a source is a bag, so that a topic can be chosen."""
    return recognises(path) if path.is_dir() else path.is_file() and is_bag_file(path)


def open_recording(path: Path, given: Given) -> Recording:
    """Open a bag: a file, or the folder of one of ROS 2."""
    paths = files_of_bag(path) if path.is_dir() else [path]
    bag = scan(paths)
    topic = _chosen(bag, given.topic, path)
    messages = bag.messages[topic]
    if not bag.is_whole:
        log.warning("%s is cut off: %d images of %s are before the cut", path, len(messages), topic.name)
    images = BagImages(bag, topic, [place for _, place in messages])
    where = f"{path}, {topic.name}"
    timestamps_s = checked_times(images.stamps_s(np.array([time_ns for time_ns, _ in messages])), where)
    info = _info_topic(bag, topic)
    camera = None if given.camera or info is None else _camera(bag, info, topic, f"{path}, {info.name}")
    calibration = "" if info is None else f"{path}, {info.name}"
    return Recording(path.stem, images, timestamps_s, camera, calibration=calibration, clock=where)


def files_of_bag(folder: Path) -> list[Path]:
    """Return the files of a ROS 2 bag, in their order."""
    found = [p for p in folder.iterdir() if p.name.lower().removesuffix(".zstd").endswith(SUFFIXES[:2])]
    return sorted(found, key=lambda p: natural_key(p.name))


def _chosen(bag: Bag, wanted: str | None, path: Path) -> Topic:
    topics = {t.name: t for t in bag.messages if t.type in (IMAGE, COMPRESSED)}
    listed = ", ".join(f"{name} ({len(bag.messages[t])})" for name, t in sorted(topics.items()))
    if wanted is not None:
        name = next((n for n in (wanted, f"/{wanted}") if n in topics), None)
        if name is None:
            raise InputError(f"{path} has no images of topic {wanted!r}; it has {listed or 'none of any topic'}.")
        return topics[name]
    if len(topics) != 1:
        if not topics:
            types = ", ".join(sorted({t.type for t in bag.messages})) or "no messages of ROS"
            raise InputError(f"{path} holds no images (sensor_msgs/Image, CompressedImage): it has {types}.")
        raise InputError(f"{path} has images of several topics: {listed}; choose one (--topic NAME).")
    return next(iter(topics.values()))


def _info_topic(bag: Bag, topic: Topic) -> Topic | None:
    """Return the `camera_info` beside a topic of images: in its namespace, or in one above."""
    parts = topic.name.split("/")[:-1]
    for n in range(len(parts), max(len(parts) - 2, 0), -1):
        name = "/".join([*parts[:n], "camera_info"])
        for known in bag.messages:
            if known.name == name and known.type == INFO:
                return known
    return None


def _camera(bag: Bag, info: Topic, topic: Topic, where: str) -> Camera | None:
    reader = BagReader(bag.paths)
    message: Any = _message(reader.read(bag.messages[info][0][1]), info)
    reader.close()
    K, D = (getattr(message, k.lower(), getattr(message, k, None)) for k in ("K", "D"))
    P = getattr(message, "p", getattr(message, "P", None))
    if K is None or not np.any(K):
        log.warning("%s is not calibrated: its K is zero", where)
        return None
    content = {
        "width": int(message.width),
        "height": int(message.height),
        "distortion_model": str(message.distortion_model),
        "binning_x": int(message.binning_x),
        "binning_y": int(message.binning_y),
        "roi": {name: int(getattr(message.roi, name)) for name in ("x_offset", "y_offset", "width", "height")},
    }
    if "rect" in topic.name.rsplit("/", 2)[-1] + topic.name.rsplit("/", 2)[-2] and P is not None and np.any(P):
        log.info("%s: the images of %s are rectified, so its P is taken", where, topic.name)
        p = np.asarray(P, float).reshape(3, 4)[:, :3]
        return camera_of_mapping(content | {"distortion_model": "none", "K": p.ravel().tolist()}, where)
    return camera_of_mapping(content | {"K": np.asarray(K).tolist(), "D": np.asarray(D).tolist()}, where)


def _message(data: bytes, topic: Topic) -> Any:
    """Return a message as the object that `rosbags` makes of it."""
    from rosbags.typesys import Stores, get_typestore

    if topic.is_ros1:
        return get_typestore(Stores.ROS1_NOETIC).deserialize_ros1(data, topic.type)
    return get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(data, topic.type)


class BagImages:
    """The images of a topic."""

    def __init__(self, bag: Bag, topic: Topic, places: list[Place]) -> None:
        self._bag, self._topic, self._places = bag, topic, places
        self.topic_name = topic.name
        self._bits: int | None = None

    def __len__(self) -> int:
        return len(self._places)

    def reader(self, grey: bool) -> ImageReader:
        """Return a reader with its own files."""
        if self._bits is None and self._topic.type == IMAGE:
            raw = _Reader(self._bag.paths, self._topic, self._places, True)
            self._bits = used_bits(len(self), lambda i: _pixels(raw.message(i), ""), self._topic.name)
            raw.close()
        return _Reader(self._bag.paths, self._topic, self._places, grey, self._bits or WHOLE)

    def told_focal(self) -> None:
        """Return nothing: a bag tells of its camera by `camera_info`."""

    def stamps_s(self, recorded_ns: NDArray[Any]) -> FloatArray:
        """Return the times at which the images were taken, by their headers; when they were recorded, if these fail."""
        reader = BagReader(self._bag.paths)
        # ROS 1: a number, seconds, nanoseconds; ROS 2: four bytes of the encoding, seconds, nanoseconds.
        stamps_ns = []
        for place in self._places:
            seconds, rest = struct.unpack_from("<II", reader.read(place).ljust(12, b"\0"), 4)  # a broken one is short
            stamps_ns.append(seconds * 10**9 + rest)
        reader.close()
        stamps = np.array(stamps_ns)
        if not (np.diff(stamps) > 0).all():
            log.warning("%s: its headers have no usable times, so the recorder's are taken", self._topic.name)
            stamps = recorded_ns
        return np.asarray(stamps // 10**9 + stamps % 10**9 * 1e-9, np.float64)


class _Reader:
    def __init__(self, paths: list[Path], topic: Topic, places: list[Place], grey: bool, bits: int = WHOLE) -> None:
        self._bag, self._topic, self._places, self._grey, self._bits = BagReader(paths), topic, places, grey, bits

    def message(self, index: int) -> Any:
        try:
            return _message(self._bag.read(self._places[index]), self._topic)
        except InputError:
            raise
        except Exception as e:  # whatever a broken message makes of the parser
            raise UnreadableImageError(f"image {index} of {self._topic.name} cannot be read: {e}.") from e

    def read(self, index: int) -> NDArray[np.uint8]:
        name, message = f"image {index} of {self._topic.name}", self.message(index)
        if self._topic.type == COMPRESSED:
            return decode(bytes(message.data), name, self._grey)
        pixels = _pixels(message, name)
        eight = upper_eight(pixels, self._bits) if pixels.dtype == np.uint16 else pixels
        return _converted(eight, TO_RGB[str(message.encoding).lower()], self._grey)

    def close(self) -> None:
        self._bag.close()


def _pixels(message: Any, name: str) -> NDArray[Any]:
    """Return the values of a raw image, of 8 or 16 bits, as its encoding has them."""
    encoding = str(message.encoding).lower()
    if encoding not in TO_RGB:
        raise UnreadableImageError(f"{name} is of encoding {encoding!r}, which is not read; take one of 8 or 16 bits.")
    height, width, step = int(message.height), int(message.width), int(message.step)
    wide = encoding.endswith("16") or encoding == "16uc1"
    data = np.asarray(message.data, np.uint8)
    if data.size < height * step or not height or not width:
        raise UnreadableImageError(f"{name} is cut off: {data.size} bytes of {height * step}.")
    rows = data[: height * step].reshape(height, step)
    if wide:
        order = ">u2" if message.is_bigendian else "<u2"
        return rows[:, : 2 * width].copy().view(order).astype(np.uint16)
    n = step // width if encoding not in ("mono8", "8uc1") and not encoding.startswith("bayer") else 1
    return rows[:, : n * width].reshape(height, width, n) if n > 1 else rows[:, :width]


def _converted(pixels: NDArray[np.uint8], code: int | None, grey: bool) -> NDArray[np.uint8]:
    """Return (H, W) grey or (H, W, 3) RGB by a conversion of OpenCV."""
    if grey and code == cv2.COLOR_GRAY2RGB:
        return np.ascontiguousarray(pixels, np.uint8)
    rgb = pixels if code is None else cv2.cvtColor(np.ascontiguousarray(pixels), code)
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) if grey else rgb, np.uint8)
