"""Position in a metric frame: GPS, RTK, motion capture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.random import Generator

from dualslam.backend.measurements.base import Gauge, Measurement, Mount, Residual, noise, point_jacobian
from dualslam.core.types import FloatArray


@dataclass(frozen=True, slots=True)
class Position(Measurement):
    """Where the antenna is.

    Attributes
    ----------
    t_s : float
    xyz_m : (float, float, float)
    sigma_m : float or (float, float, float)
    lever_arm_m : (float, float, float)
        The antenna in the camera's axes: x right, y down, z forward.
    """

    kind: ClassVar[str] = "position"
    columns: ClassVar[tuple[str, ...]] = ("t_s", "x_m", "y_m", "z_m", "sigma_x_m", "sigma_y_m", "sigma_z_m")
    units: ClassVar[tuple[str, ...]] = ("m",) * 3
    fixes: ClassVar[frozenset[Gauge]] = frozenset(Gauge)

    t_s: float
    xyz_m: tuple[float, float, float]
    sigma_m: float | tuple[float, float, float]
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def sigmas(self) -> FloatArray:
        """Along the three axes, metres."""
        return np.broadcast_to(np.asarray(self.sigma_m, np.float64), (3,))

    def residual(self, T: FloatArray, shared: FloatArray) -> Residual:
        """Return predicted minus measured position, metres."""
        arm = np.asarray(self.lever_arm_m)
        return T[0, :3, :3] @ arm + T[0, :3, 3] - np.asarray(self.xyz_m), point_jacobian(T[0], arm)

    @classmethod
    def of_row(cls, row: Sequence[float], mount: Mount) -> Self:
        """Make a reading of a line."""
        x, y, z = mount.T_cam_body[:3, 3].tolist()
        return cls(row[0], (row[1], row[2], row[3]), (row[4], row[5], row[6]), (x, y, z))

    @classmethod
    def simulate(cls, times_s: Sequence[float], T: FloatArray, sigma: float, rng: Generator | None = None) -> Self:
        """Make the reading that a true pose gives."""
        x, y, z = (T[0, :3, 3] + noise(rng, sigma, 3)).tolist()
        return cls(times_s[0], (x, y, z), sigma)
