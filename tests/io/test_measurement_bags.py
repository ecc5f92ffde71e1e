"""Measurements in bags: fixes, gyroscopes and odometry, written by rosbags."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dualslam.core.errors import InputError
from dualslam.io.measurements import read_measurements
from tests.io.test_bags import write_bag


def fill(writer) -> None:
    make, store = writer.store.types, writer.store
    quaternion, vector = make["geometry_msgs/msg/Quaternion"], make["geometry_msgs/msg/Vector3"]
    straight, none = quaternion(0.0, 0.0, 0.0, 1.0), np.zeros(36)
    name = "nav_msgs/msg/Odometry"
    odometry = writer.bag.add_connection("/odom", name, typestore=store)
    for i in range(3):
        ns = (10 + i) * 10**9
        writer.write(
            "/fix", "NavSatFix", ns, status=make["sensor_msgs/msg/NavSatStatus"](status=0, service=1), latitude=48.1,
            longitude=11.6 + 1e-4 * i, altitude=520.0, position_covariance=np.diag([1.0, 1.0, 9.0]).ravel(),
            position_covariance_type=2,
        )  # fmt: skip
        writer.write(
            "/imu", "Imu", ns, orientation=straight, orientation_covariance=np.zeros(9),
            angular_velocity=vector(0.1, 0.2, 0.3), angular_velocity_covariance=np.diag([1e-4] * 3).ravel(),
            linear_acceleration=vector(0.0, 0.0, 9.8), linear_acceleration_covariance=np.zeros(9),
        )  # fmt: skip
        stamp = make["builtin_interfaces/msg/Time"](10 + i, 0)
        at = make["geometry_msgs/msg/Pose"](make["geometry_msgs/msg/Point"](2.0 * i, 0.0, 0.0), straight)
        still = make["geometry_msgs/msg/Twist"](vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
        message = make[name](
            make["std_msgs/msg/Header"](stamp, "odom"),
            "base",
            make["geometry_msgs/msg/PoseWithCovariance"](at, none),
            make["geometry_msgs/msg/TwistWithCovariance"](still, none),
        )
        writer.bag.write(odometry, ns, store.serialize_cdr(message, name))


def test_topics_become_rows(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", "mcap", fill)
    with pytest.raises(InputError, match="/odom states no sigmas"):
        read_measurements(bag)
    source = read_measurements(bag, sigma=0.05)
    of_kind = {kind: [row.values for row in source.rows if row.kind == kind] for kind in {r.kind for r in source.rows}}
    assert [values[0] for values in of_kind["position"]] == [10.0, 11.0, 12.0]
    assert of_kind["position"][2][1] == pytest.approx(14.9, abs=0.1)
    assert of_kind["position"][0][4:] == (1.0, 1.0, 3.0)
    assert of_kind["rotation_rate"][1] == (11.0, 0.1, 0.2, 0.3, pytest.approx(0.01))
    assert of_kind["relative_pose"][1] == (11.0, 12.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.05, pytest.approx(0.005))
