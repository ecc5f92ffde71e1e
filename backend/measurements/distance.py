"""Distance between the camera at two times: a tape measure, an odometer on a straight way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.random import Generator

from dualslam.backend.measurements.base import Gauge, Measurement, Residual, noise
from dualslam.core.types import FloatArray


@dataclass(frozen=True, slots=True)
class Distance(Measurement):
    """How far two places of the camera lie apart, in a straight line.

    Attributes
    ----------
    t_a_s, t_b_s, distance_m, sigma_m : float
    """

    kind: ClassVar[str] = "distance"
    columns: ClassVar[tuple[str, ...]] = ("t_a_s", "t_b_s", "distance_m", "sigma_m")
    units: ClassVar[tuple[str, ...]] = ("m",)
    fixes: ClassVar[frozenset[Gauge]] = frozenset({Gauge.SCALE})

    t_a_s: float
    t_b_s: float
    distance_m: float
    sigma_m: float

    @property
    def sigmas(self) -> FloatArray:
        """Of the distance, metres."""
        return np.array([self.sigma_m])

    def residual(self, T: FloatArray, shared: FloatArray) -> Residual:
        """Return predicted minus measured distance, metres."""
        d = T[1, :3, 3] - T[0, :3, 3]
        length = float(np.linalg.norm(d))
        u = d / max(length, 1e-12)
        J = np.zeros((1, 12))
        J[0, 3:6], J[0, 9:12] = -u @ T[0, :3, :3], u @ T[1, :3, :3]
        return np.array([length - self.distance_m]), J

    @classmethod
    def simulate(cls, times_s: Sequence[float], T: FloatArray, sigma: float, rng: Generator | None = None) -> Self:
        """Make the reading that two true poses give."""
        length = float(np.linalg.norm(T[1, :3, 3] - T[0, :3, 3]) + noise(rng, sigma, 1)[0])
        return cls(times_s[0], times_s[1], length, sigma)
