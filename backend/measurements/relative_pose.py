"""Motion between two times: wheel odometry, or any other odometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np
from numpy.random import Generator

from dualslam.backend.measurements.base import Gauge, Measurement, Mount, Residual, between, noise
from dualslam.core.geometry import se3, so3
from dualslam.core.types import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose(Measurement):
    """How the body has moved.

    Attributes
    ----------
    t_a_s, t_b_s : float
    T_a_b : (4, 4)
        The body's second pose in its first, metres.
    sigma_m, sigma_rad : float
    mount : Mount
    """

    kind: ClassVar[str] = "relative_pose"
    columns: ClassVar[tuple[str, ...]] = (
        *("t_a_s", "t_b_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "sigma_m", "sigma_rad"),
    )
    units: ClassVar[tuple[str, ...]] = ("rad",) * 3 + ("m",) * 3
    fixes: ClassVar[frozenset[Gauge]] = frozenset({Gauge.SCALE})

    t_a_s: float
    t_b_s: float
    T_a_b: FloatArray
    sigma_m: float
    sigma_rad: float
    mount: Mount = field(default_factory=Mount)

    @property
    def sigmas(self) -> FloatArray:
        """Rotation (rad), then translation (metres)."""
        return np.array([self.sigma_rad] * 3 + [self.sigma_m] * 3)

    @property
    def turn_rad(self) -> FloatArray:
        """Rotation vector of the body's motion."""
        return so3.log(self.T_a_b[:3, :3])

    def residual(self, T: FloatArray, shared: FloatArray) -> Residual:
        """Return the logarithm of the motion that is left over."""
        return between(T, self.mount.T_cam_body, self.T_a_b)

    @classmethod
    def of_row(cls, row: Sequence[float], mount: Mount) -> Self:
        """Make a reading of a line."""
        T = se3.from_parts(so3.matrix_from_quat_xyzw(row[5:9]), row[2:5])
        return cls(row[0], row[1], T, row[9], row[10], mount)

    @classmethod
    def simulate(cls, times_s: Sequence[float], T: FloatArray, sigma: float, rng: Generator | None = None) -> Self:
        """Make the reading of a sensor at the camera; `sigma` is that of translation, a tenth of it per radian."""
        motion = se3.inverse(T[0]) @ T[1] @ se3.exp(np.repeat([0.1, 1.0], 3) * noise(rng, sigma, 6))
        return cls(times_s[0], times_s[1], motion, sigma, 0.1 * sigma)
