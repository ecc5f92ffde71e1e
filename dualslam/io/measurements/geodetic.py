"""Latitude, longitude and height on the WGS 84 ellipsoid, and metres east, north, up of an origin."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dualslam.core.errors import InputError
from dualslam.core.metric_problem import MeasurementRow
from dualslam.core.types import FloatArray

FIX = "fix"
"""Kind of a row of time, latitude, longitude, height, horizontal and vertical sigma."""
VERTICAL = 2.0
"""A satellite receiver's height is about twice as uncertain as its place."""

A_M, E2 = 6378137.0, 6.69437999014e-3
"""Semi-major axis and squared eccentricity of WGS 84."""
N_ROUNDS = 5
"""Of the iteration for the latitude: each gains three digits near the ground."""

Geodetic = tuple[float, float, float]


def required_sigma(sigma: float | None, where: object) -> float:
    """Return a sigma that has to be given; raises `InputError` if it was not."""
    if sigma is None or not sigma > 0:
        raise InputError(f"{where} states no sigmas; give --sigma (metres of a position; rad/s, rad of an IMU).")
    return sigma


def fix_row(path: Path, t: float, llh: Sequence[float], sigma: float | None) -> MeasurementRow:
    """Return the row of a receiver's position."""
    s = required_sigma(sigma, path)
    return MeasurementRow(FIX, (t, *llh, s, VERTICAL * s), str(path))


def to_enu(llh: FloatArray, origin: Geodetic) -> FloatArray:
    """Return (N, 3) metres east, north, up of (N, 3) degrees, degrees, metres."""
    return np.asarray((_ecef(llh) - _ecef(np.array([origin]))) @ _axes(origin).T)


def from_enu(enu: FloatArray, origin: Geodetic) -> FloatArray:
    """Return (N, 3) latitude, longitude (degrees), height (metres) of metres east, north, up."""
    x, y, z = (np.asarray(enu) @ _axes(origin) + _ecef(np.array([origin]))).T
    p = np.hypot(x, y)
    latitude = np.arctan2(z, p * (1 - E2))
    h = np.zeros_like(p)
    for _ in range(N_ROUNDS):
        n = A_M / np.sqrt(1 - E2 * np.sin(latitude) ** 2)
        h = p * np.cos(latitude) + z * np.sin(latitude) - A_M * A_M / n
        latitude = np.arctan2(z, p * (1 - E2 * n / (n + h)))
    return np.stack((np.degrees(latitude), np.degrees(np.arctan2(y, x)), h), axis=1)


def _ecef(llh: FloatArray) -> FloatArray:
    latitude, longitude = np.radians(llh[:, 0]), np.radians(llh[:, 1])
    n = A_M / np.sqrt(1 - E2 * np.sin(latitude) ** 2)
    across = (n + llh[:, 2]) * np.cos(latitude)
    z = (n * (1 - E2) + llh[:, 2]) * np.sin(latitude)
    return np.stack((across * np.cos(longitude), across * np.sin(longitude), z), axis=1)


def _axes(origin: Geodetic) -> FloatArray:
    """Return the axes east, north, up as rows (3, 3) in earth-fixed coordinates."""
    latitude, longitude = np.radians(origin[0]), np.radians(origin[1])
    s, c = np.sin(latitude), np.cos(latitude)
    sl, cl = np.sin(longitude), np.cos(longitude)
    return np.array([[-sl, cl, 0.0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])
