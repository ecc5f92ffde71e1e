"""Measurements in a bag: topics of `NavSatFix`, `Odometry` and `Imu`."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from dualslam.core.errors import InputError
from dualslam.core.geometry import se3, so3
from dualslam.core.metric_problem import MeasurementRow
from dualslam.core.types import FloatArray
from dualslam.io.bag_files import BagReader, scan
from dualslam.io.bags import SUFFIXES, _message

FIX, IMU, ODOMETRY = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry"
STEP_S = 0.5
"""Odometry is taken from one time to the next at this distance: its errors over shorter ones are not independent."""
RAD_PER_M = 0.1
"""Sigma of a step's turn over that of its length, where the bag states none."""


def read_bag(
    path: Path, sigma: float | None
) -> tuple[list[MeasurementRow], list[tuple[float, float, float, float, float, float]]]:
    """Return rows of odometry and gyroscopes, and fixes: time, latitude, longitude, height, two sigmas.

    Raises `InputError` if the bag has no such topic, or states no sigmas and none is given.
    """
    paths = [path] if path.is_file() else sorted(p for p in path.iterdir() if p.suffix.lower() in SUFFIXES)
    bag = scan(paths)
    reader = BagReader(paths)
    rows: list[MeasurementRow] = []
    fixes: list[tuple[float, float, float, float, float, float]] = []
    try:
        for topic, messages in bag.messages.items():
            if topic.type not in (FIX, IMU, ODOMETRY):
                continue
            where = f"{path}, {topic.name}"
            known: list[tuple[float, FloatArray]] = []
            for time_ns, place in messages:
                message: Any = _message(reader.read(place), topic)
                stamp = message.header.stamp
                t = float(stamp.sec) + 1e-9 * float(stamp.nanosec) or 1e-9 * time_ns
                if topic.type == FIX and message.status.status >= 0:
                    C = np.asarray(message.position_covariance, float).reshape(3, 3)
                    h = _sigma(float(np.sqrt(max(C[0, 0], C[1, 1], 0.0))), sigma, where)
                    v = _sigma(float(np.sqrt(max(C[2, 2], 0.0))), 2 * h, where)
                    fixes.append((t, message.latitude, message.longitude, message.altitude, h, v))
                elif topic.type == IMU:
                    C = np.asarray(message.angular_velocity_covariance, float)
                    w = message.angular_velocity
                    s = _sigma(float(np.sqrt(max(C[0], 0.0))), sigma, where)
                    rows.append(MeasurementRow("rotation_rate", (t, w.x, w.y, w.z, s), where))
                elif topic.type == ODOMETRY and (not known or t - known[-1][0] >= STEP_S):
                    p, q = message.pose.pose.position, message.pose.pose.orientation
                    R = so3.matrix_from_quat_xyzw([q.x, q.y, q.z, q.w])
                    known.append((t, se3.from_parts(R, [p.x, p.y, p.z])))
            for (t_a, T_a), (t_b, T_b) in pairwise(known):
                T = se3.inverse(T_a) @ T_b
                s = _sigma(0.0, sigma, where)
                numbers = (*T[:3, 3].tolist(), *so3.quat_xyzw_from_matrix(T[:3, :3]).tolist(), s, RAD_PER_M * s)
                rows.append(MeasurementRow("relative_pose", (t_a, t_b, *numbers), where))
    finally:
        reader.close()
    if not rows and not fixes:
        raise InputError(f"{path} has no topic of NavSatFix, Odometry or Imu; give a file of measurements.")
    return rows, fixes


def _sigma(stated: float, given: float | None, where: str) -> float:
    if stated > 0:
        return stated
    if given is None or not given > 0:
        raise InputError(f"{where} states no sigmas; give --sigma (metres of a position; rad/s of a gyroscope).")
    return given
