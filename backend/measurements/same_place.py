"""The camera stood at the same place, looking the same way: a loop that a person has set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.random import Generator

from dualslam.backend.measurements.base import Gauge, Measurement, Residual, between
from dualslam.core.types import FloatArray


@dataclass(frozen=True, slots=True)
class SamePlace(Measurement):
    """Two times at which the camera had one pose, up to the sigmas.

    Attributes
    ----------
    t_a_s, t_b_s, sigma_m, sigma_rad : float
    """

    kind: ClassVar[str] = "same_place"
    columns: ClassVar[tuple[str, ...]] = ("t_a_s", "t_b_s", "sigma_m", "sigma_rad")
    units: ClassVar[tuple[str, ...]] = ("rad",) * 3 + ("m",) * 3
    fixes: ClassVar[frozenset[Gauge]] = frozenset()

    t_a_s: float
    t_b_s: float
    sigma_m: float
    sigma_rad: float

    @property
    def sigmas(self) -> FloatArray:
        """Rotation (rad), then translation (metres)."""
        return np.array([self.sigma_rad] * 3 + [self.sigma_m] * 3)

    def residual(self, T: FloatArray, shared: FloatArray) -> Residual:
        """Return the logarithm of the motion between the two poses."""
        return between(T, np.eye(4), np.eye(4))

    @classmethod
    def simulate(cls, times_s: Sequence[float], T: FloatArray, sigma: float, rng: Generator | None = None) -> Self:
        """Make the reading of two poses that are one; `sigma`: metres, and a tenth of it per radian."""
        return cls(times_s[0], times_s[1], sigma, 0.1 * sigma)
