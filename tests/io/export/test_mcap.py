"""MCAP files, read back by rosbags: transforms, points, images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from dualslam.core.errors import InputError
from dualslam.core.geometry import so3
from dualslam.io.export.exported_map import ExportedMap
from dualslam.io.export.mcap import R_MAP_WORLD, write_mcap

SIZE = (64, 48)
N = 5


@pytest.fixture
def exported() -> ExportedMap:
    """Five views on a curve, of which all see four points."""
    T = np.tile(np.eye(4), (N, 1, 1))
    for i in range(N):
        T[i, :3, :3] = so3.exp(np.array([0.0, 0.1 * i, 0.0]))
        T[i, :3, 3] = (0.2 * i, 0.0, 0.1)
    rng = np.random.default_rng(0)
    observed = np.arange(4 * N)
    return ExportedMap(
        frame=10 + np.arange(N),
        timestamp_s=1_700_000_000.5 + 0.1 * np.arange(N),
        camera=np.zeros(N, np.int64),
        K=np.array([[[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]]]),
        size_px=SIZE,
        T_world_cam=T,
        xyz=rng.uniform(1, 3, (4, 3)),
        colour=np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [10, 20, 30]], np.uint8),
        view=observed % N,
        point=observed // N,
        uv_px=np.zeros((4 * N, 2)),
        sigma_px=np.ones(4 * N),
        feature=observed,
    )


def read(path: Path) -> dict[str, list[Any]]:
    """Return the messages of each topic."""
    found: dict[str, list[Any]] = {}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, _, raw in reader.messages():
            found.setdefault(connection.topic, []).append(reader.deserialize(raw, connection.msgtype))
    return found


def test_poses_points_and_images_are_those_of_the_map(exported: ExportedMap, tmp_path: Path) -> None:
    rows = np.arange(1, N)  # the first view is of a saved map
    red = np.full((*SIZE[::-1], 3), (200, 20, 40), np.uint8)
    write_mcap(exported, rows, [(1, red), (3, red[..., 0])], tmp_path / "run.mcap")
    read_back = read(tmp_path / "run.mcap")
    poses = read_back["/tf"], read_back["/camera/pose"], read_back["/trajectory"][0].poses
    assert [len(each) for each in poses] == [len(rows)] * 3
    for row, message in zip(rows, read_back["/tf"], strict=True):
        (stamped,) = message.transforms
        assert (stamped.header.frame_id, stamped.child_frame_id) == ("world", "camera")
        stamp = stamped.header.stamp
        assert stamp.sec + 1e-9 * stamp.nanosec == pytest.approx(exported.timestamp_s[row], abs=1e-6)
        t, q = stamped.transform.translation, stamped.transform.rotation
        np.testing.assert_allclose([t.x, t.y, t.z], exported.T_world_cam[row, :3, 3], atol=1e-12)
        R = so3.matrix_from_quat_xyzw(np.array([q.x, q.y, q.z, q.w]))
        np.testing.assert_allclose(R, exported.T_world_cam[row, :3, :3], atol=1e-12)
    (cloud,) = read_back["/map/points"]
    points = np.frombuffer(cloud.data.tobytes(), "<f4").reshape(-1, 4)
    np.testing.assert_allclose(points[:, :3], exported.xyz, rtol=1e-6)
    rgb = np.frombuffer(cloud.data.tobytes(), "<u4").reshape(-1, 4)[:, 3]
    assert rgb.tolist() == [0xFF0000, 0x00FF00, 0x0000FF, 0x0A141E]
    colour, grey = read_back["/camera/image/compressed"]
    shown = cv2.cvtColor(cv2.imdecode(colour.data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    assert np.abs(shown.astype(int) - red).max() <= 3
    assert cv2.imdecode(grey.data, cv2.IMREAD_UNCHANGED).shape == SIZE[::-1]
    assert [info.k.tolist() for info in read_back["/camera/camera_info"]] == 2 * [exported.K[0].ravel().tolist()]


def test_up_is_z_in_the_map_frame() -> None:
    down, ahead = np.array([0, 1, 0]), np.array([0, 0, 1])
    assert (R_MAP_WORLD @ -down).tolist() == [0, 0, 1]
    assert (R_MAP_WORLD @ ahead).tolist() == [1, 0, 0]
    assert np.linalg.det(R_MAP_WORLD) == pytest.approx(1)


def test_times_that_are_no_stamps_are_refused(exported: ExportedMap, tmp_path: Path) -> None:
    early = replace(exported, timestamp_s=exported.timestamp_s - 1_800_000_000)
    with pytest.raises(InputError, match="stamps of ROS"):
        write_mcap(early, np.arange(N), [], tmp_path / "run.mcap")
    assert list(tmp_path.iterdir()) == []
