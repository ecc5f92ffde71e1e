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
from dualslam.io.bags import _message, files_of_bag
from dualslam.io.measurements.geodetic import FIX, required_sigma

NAV_SAT_FIX, IMU, ODOMETRY = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry"
STEP_S = 0.5
"""Odometry is taken from one time to the next at this distance: its errors over shorter ones are not independent."""
RAD_PER_M = 0.1
"""Sigma of a step's turn over that of its length, where the bag states none."""


def bag_rows(path: Path, sigma: float | None) -> list[MeasurementRow]:
    """Return rows of fixes, odometry and gyroscopes.

    Raises `InputError` if the bag has no such topic, or states no sigmas and none is given.
    """
    bag = scan([path] if path.is_file() else files_of_bag(path))
    reader, rows = BagReader(bag.paths), list[MeasurementRow]()
    try:
        for topic, messages in bag.messages.items():
            where, known = f"{path}, {topic.name}", list[tuple[float, FloatArray]]()
            for time_ns, place in messages if topic.type in (NAV_SAT_FIX, IMU, ODOMETRY) else ():
                message: Any = _message(reader.read(place), topic)
                stamp = message.header.stamp
                t = float(stamp.sec) + 1e-9 * float(stamp.nanosec) or 1e-9 * time_ns
                if topic.type == NAV_SAT_FIX and message.status.status >= 0:
                    C = np.asarray(message.position_covariance, float)[[0, 4, 8]]
                    h = _sigma(C[:2], sigma, where)
                    llh = message.latitude, message.longitude, message.altitude
                    rows.append(MeasurementRow(FIX, (t, *llh, h, _sigma(C[2:], 2 * h, where)), where))
                elif topic.type == IMU:
                    w, C = message.angular_velocity, np.asarray(message.angular_velocity_covariance, float)
                    rows.append(MeasurementRow("rotation_rate", (t, w.x, w.y, w.z, _sigma(C[:1], sigma, where)), where))
                elif topic.type == ODOMETRY and (not known or t - known[-1][0] >= STEP_S):
                    p, q = message.pose.pose.position, message.pose.pose.orientation
                    R = so3.matrix_from_quat_xyzw([q.x, q.y, q.z, q.w])
                    known.append((t, se3.from_parts(R, [p.x, p.y, p.z])))
            for (t_a, T_a), (t_b, T_b) in pairwise(known):
                T, s = se3.inverse(T_a) @ T_b, required_sigma(sigma, where)
                motion = *T[:3, 3].tolist(), *so3.quat_xyzw_from_matrix(T[:3, :3]).tolist()
                rows.append(MeasurementRow("relative_pose", (t_a, t_b, *motion, s, RAD_PER_M * s), where))
    finally:
        reader.close()
    if not rows:
        raise InputError(f"{path} has no topic of NavSatFix, Odometry or Imu; give a file of measurements.")
    return rows


def _sigma(variances: FloatArray, given: float | None, where: str) -> float:
    """Return the largest sigma that a message states; if it states none, the given one."""
    stated = float(np.sqrt(max(variances.max(), 0.0)))
    return stated if stated > 0 else required_sigma(given, where)
