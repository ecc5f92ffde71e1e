"""What sensors beside the camera know of its motion while a run goes on."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from dualslam.core.geometry import se3, so3
from dualslam.core.noise_model import GATE_SIGMAS
from dualslam.core.types import Failure, FailureReason, FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Turn:
    """The camera's rotation from one time to another."""

    R_a_b: FloatArray  # (3, 3)
    sigma_rad: float  # about each axis

    def after(self, R_map_a: FloatArray) -> Turn:
        """Return the turn from the axes of a map in which the camera's rotation at the first time is given."""
        return Turn(R_map_a @ self.R_a_b, self.sigma_rad)

    def of(self, T_cam_map: FloatArray) -> FloatArray:
        """Return a pose in the map, of the second time, with this rotation and the camera where it is."""
        R = self.R_a_b.T
        return se3.from_parts(R, R @ T_cam_map[:3, :3].T @ T_cam_map[:3, 3])

    def refuse(self, R_a_b: FloatArray, covariance: FloatArray) -> Failure | None:
        """Return why a rotation of this covariance, whose first three rows are the rotation's, cannot be this one."""
        off = float(so3.rotation_angle(self.R_a_b.T @ R_a_b))
        limit = GATE_SIGMAS * float(np.sqrt(self.sigma_rad**2 + np.linalg.eigvalsh(covariance[:3, :3])[-1]))
        if off <= limit:
            return None
        off_deg, limit_deg = np.degrees([off, limit]).tolist()
        detail = f"it turns by {off_deg:.1f} deg against the gyroscope or odometry, {limit_deg:.1f} deg allowed"
        return Failure(FailureReason.LEAP, detail, {"turn_off_deg": off_deg})


class MotionPrior(Protocol):
    """Says how the camera has turned; independent of its images."""

    def turn(self, t_a_s: float, t_b_s: float) -> Turn | None:
        """Return the turn between two times, in either order; None where it is not known."""
        ...


class LivePrior(MotionPrior, Protocol):
    """One that learns from the frames how its sensor is mounted, its bias and its clock."""

    @property
    def known(self) -> MotionPrior | None:
        """What it knows now, which changes no more; None before it has seen enough frames."""
        ...

    def add(self, readings: Iterable[Any]) -> None:
        """Take readings; only those of turns count."""
        ...

    def note(self, timestamp_s: float, R_map_cam: FloatArray, submap_id: int) -> None:
        """Learn from a posed frame."""
        ...
