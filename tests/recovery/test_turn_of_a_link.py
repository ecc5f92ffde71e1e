"""A link is refused if the turn that it makes between two maps is not the one that a gyroscope measured."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from dualslam.atlas.trajectory import Path
from dualslam.core.geometry import se3, so3
from dualslam.core.motion_prior import Turn
from dualslam.core.trajectory import Trajectory
from dualslam.core.types import FailureReason
from dualslam.recovery.manager import Recoveries


def path(times_s: list[float], yaw_rad: float, first: int) -> Path:
    T = se3.from_parts(so3.exp(np.outer(np.ones(len(times_s)), [0.0, yaw_rad, 0.0])), np.zeros((len(times_s), 3)))
    return Path.of_trajectory(Trajectory(np.array(times_s), T, first + np.arange(len(times_s))))


class Gyroscope:
    def turn(self, t_a_s, t_b_s):
        """Half a radian a second, known to half a degree."""
        return Turn(so3.exp([0.0, 0.5 * (t_b_s - t_a_s), 0.0]), np.radians(0.5))


@pytest.mark.parametrize(("yaw_rad", "refused"), [(1.0, False), (1.02, False), (1.2, True), (0.0, True)])
def test_link_against_the_gyroscope(yaw_rad, refused):
    old, live = path([0.8, 0.9, 1.0], 0.0, 8), path([3.0, 3.1], yaw_rad, 30)  # 2 s between them
    times = dict(zip([*old.index.tolist(), *live.index.tolist()], [0.8, 0.9, 1.0, 3.0, 3.1], strict=True))
    poses = {i: SimpleNamespace(timestamp_s=t) for i, t in times.items()}
    recoveries = SimpleNamespace(_prior=Gyroscope(), _record=SimpleNamespace(poses=poses))
    found = Recoveries._refuse_turn(recoveries, old, live, SimpleNamespace(covariance=np.eye(7) * 1e-6))
    assert (found is not None) is refused
    assert found is None or found.reason is FailureReason.LEAP
