"""A map and its poses as an MCAP file of ROS 2 messages, for Foxglove, Rerun and `ros2 bag play`."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.errors import InputError, how_to_install
from dualslam.core.geometry import so3
from dualslam.core.types import FloatArray, IntArray
from dualslam.io.atomic import atomic_file
from dualslam.io.export.exported_map import ExportedMap

MAP, WORLD, CAMERA = "map", "world", "camera"
"""Frames of the transforms: `map` is `world` with its z-axis up, as ROS has it (REP 103)."""
R_MAP_WORLD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""The world is the first camera's frame: x to the right, y down, z ahead."""
JPEG_QUALITY = 90
MAX_STAMP_S = 2**31
"""ROS counts seconds in 32 bits."""
POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
FLOAT32, UINT32 = 7, 6


def write_mcap(
    exported: ExportedMap, rows: IntArray, images: Iterable[tuple[int, NDArray[np.uint8]]], out: Path
) -> None:
    """Write poses, points and images; one image at a time is in memory.

    - `exported`: all posed frames are views of it.
    - `rows` (N,): views that are frames of the run, by time.
    - `images` (iterable of (int, array)): some of these views, ascending, and their images without the lens: (H, W)
      grey or (H, W, 3) RGB.
    - `out`: the file.

    Raises `InputError` if `rosbags` is not installed, or a time cannot be a stamp of ROS.
    """
    times_s = exported.timestamp_s[rows]
    if not ((times_s >= 0) & (times_s < MAX_STAMP_S)).all():
        raise InputError(f"a frame is at {times_s.min():g} s; stamps of ROS are 0 s or later, and of 32 bits.")
    with TemporaryDirectory() as folder, _Messages(Path(folder) / "bag") as messages:
        start_s = float(times_s.min())
        messages.transform("/tf_static", start_s, MAP, WORLD, R_MAP_WORLD, np.zeros(3))
        messages.points("/map/points", start_s, exported)
        messages.path("/trajectory", start_s, times_s, exported.T_world_cam[rows])
        for v in rows.tolist():
            T = exported.T_world_cam[v]
            messages.transform("/tf", exported.timestamp_s[v], WORLD, CAMERA, T[:3, :3], T[:3, 3])
            messages.pose("/camera/pose", exported.timestamp_s[v], T)
        for v, image in images:
            K = exported.K[exported.camera[v]]
            messages.image("/camera/image/compressed", exported.timestamp_s[v], image)
            messages.camera_info("/camera/camera_info", exported.timestamp_s[v], K, exported.size_px)
        written = messages.close()
        with atomic_file(out) as target, written.open("rb") as source:
            shutil.copyfileobj(source, target)


class _Messages:
    """Writes messages of ROS 2 into an MCAP file."""

    def __init__(self, folder: Path) -> None:
        try:
            from rosbags.rosbag2 import StoragePlugin, Writer
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise InputError(f"MCAP files are written by rosbags: {how_to_install('bags')}.") from None
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        self._writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        self._connections: dict[str, Any] = {}
        self._is_open = False

    def __enter__(self) -> Self:
        self._writer.open()
        self._is_open = True
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        if self._is_open:
            self._writer.close()

    def close(self) -> Path:
        """End the file, and return where it is."""
        self._writer.close()
        self._is_open = False
        return next(self._writer.path.glob("*.mcap"))

    def transform(self, topic: str, t_s: float, parent: str, child: str, R: FloatArray, t: FloatArray) -> None:
        """Write `T_parent_child`."""
        moved = self._of("geometry_msgs/msg/Transform", self._vector(t), self._quaternion(R))
        stamped = self._of("geometry_msgs/msg/TransformStamped", self._header(t_s, parent), child, moved)
        self._write(topic, t_s, self._of("tf2_msgs/msg/TFMessage", [stamped]))

    def pose(self, topic: str, t_s: float, T: FloatArray) -> None:
        """Write the camera's pose in the world."""
        self._write(topic, t_s, self._stamped_pose(t_s, T))

    def path(self, topic: str, t_s: float, times_s: FloatArray, T: FloatArray) -> None:
        """Write all poses (N, 4, 4) as one path."""
        poses = [self._stamped_pose(at, pose) for at, pose in zip(times_s.tolist(), T, strict=True)]
        self._write(topic, t_s, self._of("nav_msgs/msg/Path", self._header(t_s, WORLD), poses))

    def points(self, topic: str, t_s: float, exported: ExportedMap) -> None:
        """Write the points with their colours."""
        cloud = np.zeros(len(exported.xyz), POINT)
        for column, axis in enumerate("xyz"):
            cloud[axis] = exported.xyz[:, column]
        cloud["rgb"] = exported.colour.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
        fields = [
            self._of("sensor_msgs/msg/PointField", name, 4 * i, UINT32 if name == "rgb" else FLOAT32, 1)
            for i, name in enumerate(POINT.names or ())
        ]
        n, size, data = len(cloud), POINT.itemsize, np.frombuffer(cloud.tobytes(), np.uint8)
        header, is_bigendian, is_dense = self._header(t_s, WORLD), False, True
        kind = "sensor_msgs/msg/PointCloud2"
        self._write(topic, t_s, self._of(kind, header, 1, n, fields, is_bigendian, size, n * size, data, is_dense))

    def image(self, topic: str, t_s: float, image: NDArray[np.uint8]) -> None:
        """Write a grey or an RGB image as JPEG; OpenCV encodes BGR."""
        bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
        encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].ravel()
        header = self._header(t_s, CAMERA)
        self._write(topic, t_s, self._of("sensor_msgs/msg/CompressedImage", header, "jpeg", encoded))

    def camera_info(self, topic: str, t_s: float, K: FloatArray, size_px: tuple[int, int]) -> None:
        """Write the pinhole of an image."""
        width, height = size_px
        region = self._of("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        P = np.hstack([K, np.zeros((3, 1))])
        content = (height, width, "plumb_bob", np.zeros(5), K.ravel(), np.eye(3).ravel(), P.ravel(), 0, 0, region)
        self._write(topic, t_s, self._of("sensor_msgs/msg/CameraInfo", self._header(t_s, CAMERA), *content))

    def _stamped_pose(self, t_s: float, T: FloatArray) -> Any:
        point = self._of("geometry_msgs/msg/Point", *T[:3, 3].tolist())
        pose = self._of("geometry_msgs/msg/Pose", point, self._quaternion(T[:3, :3]))
        return self._of("geometry_msgs/msg/PoseStamped", self._header(t_s, WORLD), pose)

    def _vector(self, t: FloatArray) -> Any:
        return self._of("geometry_msgs/msg/Vector3", *t.tolist())

    def _quaternion(self, R: FloatArray) -> Any:
        return self._of("geometry_msgs/msg/Quaternion", *so3.quat_xyzw_from_matrix(R).tolist())

    def _header(self, t_s: float, frame_id: str) -> Any:
        stamp = self._of("builtin_interfaces/msg/Time", *divmod(_nanoseconds(t_s), 10**9))
        return self._of("std_msgs/msg/Header", stamp, frame_id)

    def _of(self, kind: str, *fields: Any) -> Any:
        return self._store.types[kind](*fields)

    def _write(self, topic: str, t_s: float, message: Any) -> None:
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        data = self._store.serialize_cdr(message, kind)
        self._writer.write(self._connections[topic], _nanoseconds(t_s), data)


def _nanoseconds(t_s: float) -> int:
    return round(t_s * 1e9)
