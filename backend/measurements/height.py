"""Height along the measurements' z axis: barometer, the floor of a building."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.random import Generator

from dualslam.backend.measurements.base import Gauge, Measurement, Residual, noise, point_jacobian
from dualslam.core.types import FloatArray


@dataclass(frozen=True, slots=True)
class Height(Measurement):
    """The z coordinate of the camera.

    Attributes
    ----------
    t_s, z_m, sigma_m : float
    """

    kind: ClassVar[str] = "height"
    columns: ClassVar[tuple[str, ...]] = ("t_s", "z_m", "sigma_m")
    units: ClassVar[tuple[str, ...]] = ("m",)
    fixes: ClassVar[frozenset[Gauge]] = frozenset(Gauge)

    t_s: float
    z_m: float
    sigma_m: float

    @property
    def sigmas(self) -> FloatArray:
        """Of the height, metres."""
        return np.array([self.sigma_m])

    def residual(self, T: FloatArray, shared: FloatArray) -> Residual:
        """Return predicted minus measured height, metres."""
        return np.array([T[0, 2, 3] - self.z_m]), point_jacobian(T[0], np.zeros(3))[2:]

    @classmethod
    def simulate(cls, times_s: Sequence[float], T: FloatArray, sigma: float, rng: Generator | None = None) -> Self:
        """Make the reading that a true pose gives."""
        return cls(times_s[0], float(T[0, 2, 3] + noise(rng, sigma, 1)[0]), sigma)
