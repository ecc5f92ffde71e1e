"""A direction that is known in the world and seen by the body: gravity, north."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.random import Generator

from dualslam.backend.measurements.base import Gauge, Measurement, Mount, Residual, noise
from dualslam.core.geometry import so3
from dualslam.core.types import FloatArray

Vector = tuple[float, float, float]
SIMULATED: Vector = (0.0, 0.0, -1.0)


def _unit(v: Sequence[float] | FloatArray) -> FloatArray:
    a = np.asarray(v, np.float64)
    return np.asarray(a / np.linalg.norm(a))


@dataclass(frozen=True, slots=True)
class Direction(Measurement):
    """A direction in the camera's axes, and the same one in the measurements' frame.

    Attributes
    ----------
    t_s : float
    in_camera, in_world : (float, float, float)
        Of any length. Gravity: down in both.
    sigma_rad : float
    """

    kind: ClassVar[str] = "direction"
    columns: ClassVar[tuple[str, ...]] = ("t_s", "bx", "by", "bz", "wx", "wy", "wz", "sigma_rad")
    units: ClassVar[tuple[str, ...]] = ("rad",) * 3
    fixes: ClassVar[frozenset[Gauge]] = frozenset({Gauge.ROTATION})

    t_s: float
    in_camera: Vector
    in_world: Vector
    sigma_rad: float

    @property
    def sigmas(self) -> FloatArray:
        """Of each component of the unit vector, rad."""
        return np.full(3, self.sigma_rad)

    def residual(self, T: FloatArray, shared: FloatArray) -> Residual:
        """Return the difference of the two unit vectors, in the measurements' frame."""
        R, d = T[0, :3, :3], _unit(self.in_camera)
        return R @ d - _unit(self.in_world), np.hstack((-R @ so3.hat(d), np.zeros((3, 3))))

    @classmethod
    def of_row(cls, row: Sequence[float], mount: Mount) -> Self:
        """Make a reading of a line."""
        x, y, z = (mount.T_cam_body[:3, :3] @ np.asarray(row[1:4])).tolist()
        return cls(row[0], (x, y, z), (row[4], row[5], row[6]), row[7])

    @classmethod
    def simulate(cls, times_s: Sequence[float], T: FloatArray, sigma: float, rng: Generator | None = None) -> Self:
        """Make the reading of gravity, which points along minus z."""
        x, y, z = (so3.exp(noise(rng, sigma, 3)) @ T[0, :3, :3].T @ np.asarray(SIMULATED)).tolist()
        return cls(times_s[0], (x, y, z), SIMULATED, sigma)
