"""The protocol of a measurement: what a sensor beside the camera says about one or two camera poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import ClassVar, Protocol, Self

import numpy as np
from numpy.random import Generator

from dualslam.core.geometry import se3, so3
from dualslam.core.types import FloatArray

Residual = tuple[FloatArray, FloatArray]
"""Residual (d,) and its Jacobian (d, 6 k + n): right perturbations of k poses, then the n shared unknowns."""


class Gauge(StrEnum):
    """Parts of the similarity, from the map to its own frame, that a measurement can fix."""

    TRANSLATION = "translation"
    ROTATION = "rotation"
    SCALE = "scale"


@dataclass(frozen=True, slots=True, eq=False)
class Mount:
    """How a sensor is fixed to the camera."""

    T_cam_body: FloatArray = field(default_factory=lambda: np.eye(4))  # to x right, y down, z forward; metres
    is_given: bool = False
    """False: the turn of a sensor that measures rotations is estimated; its place is taken to be the camera's."""


class Measurement(Protocol):
    """One reading with its sigmas: a frozen dataclass, which may inherit from this one. `conformance` checks it all."""

    kind: ClassVar[str]  # the word that names it in files and in the registry
    columns: ClassVar[tuple[str, ...]]  # of its line in a file, after the kind
    units: ClassVar[tuple[str, ...]]  # `m` or `rad` for each component of the residual
    fixes: ClassVar[frozenset[Gauge]] = frozenset()
    shared_sigmas: ClassVar[tuple[float, ...]] = ()
    """Of the unknowns that all readings of a kind share, such as a bias; their mean is 0."""

    @property
    def times_s(self) -> tuple[float, ...]:
        """Times of the poses that it is about, on the sensor's clock: the columns that begin with ``t_``."""
        return tuple(getattr(self, name) for name in self.columns if name.startswith("t_"))

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations of the residual: the fields `sigma_m` and `sigma_rad`, by its units."""
        return np.array([getattr(self, f"sigma_{unit}") for unit in self.units])

    def residual(self, T: FloatArray, shared: FloatArray) -> Residual:
        """Compare with poses T (k, 4, 4), camera to the measurements' frame, and with shared unknowns (n,)."""
        ...

    @classmethod
    def of_row(cls, row: Sequence[float], mount: Mount) -> Self:
        """Make a reading of the numbers of a line, in the order of `columns`: the fields, where there are no others."""
        return cls(*row)

    @classmethod
    def simulate(cls, times_s: Sequence[float], T: FloatArray, sigma: float, rng: Generator | None = None) -> Self:
        """Make the reading that true poses (k, 4, 4) give, with noise of a standard deviation; None: exact."""
        ...


def noise(rng: Generator | None, sigma: float, n: int) -> FloatArray:
    """Return n normal numbers; zeros without a generator."""
    return np.zeros(n) if rng is None else rng.normal(0.0, sigma, n)


def point_jacobian(T: FloatArray, p_cam: FloatArray) -> FloatArray:
    """Return the derivative (3, 6) of ``T @ p_cam`` by a right perturbation of a pose."""
    R = se3.rotation(T)
    return np.asarray(np.hstack((-R @ so3.hat(p_cam), R)))


def between(T: FloatArray, T_cam_body: FloatArray, T_a_b: FloatArray) -> Residual:
    """Compare a body's motion, its second pose in its first, with two poses (2, 4, 4): (6,), (6, 12).

    Rotation stands before translation.
    """
    T_b_a = se3.inverse(T[1] @ T_cam_body) @ T[0] @ T_cam_body
    r = se3.log(se3.inverse(T_b_a @ T_a_b))
    J_r = se3.right_jacobian_inverse(r)
    Ad = se3.adjoint(se3.inverse(T_cam_body))
    return r, np.hstack((-J_r @ se3.adjoint(T_b_a) @ Ad, J_r @ Ad))
