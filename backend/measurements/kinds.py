"""The built-in measurements: position, height, direction, distance, motion, known loops, and rates of turning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np
from numpy.random import Generator

from dualslam.backend.measurements.base import Gauge, Measurement, Mount, Residual, between, noise, point_jacobian
from dualslam.core.geometry import se3, so3
from dualslam.core.noise_model import TINY
from dualslam.core.types import FloatArray

Vector = tuple[float, float, float]
DOWN: Vector = (0.0, 0.0, -1.0)
MOTION_UNITS = ("rad",) * 3 + ("m",) * 3
BIAS_SIGMA_RAD_S = 0.05
"""Of a phone's gyroscope that was never calibrated: 3 degrees a second."""
MAX_GAP_S = 0.1
"""Between two readings: across a longer gap nothing is integrated."""


@dataclass(frozen=True, slots=True)
class Position(Measurement):
    """Where an antenna is: GPS, RTK, motion capture."""

    kind: ClassVar[str] = "position"
    columns: ClassVar[tuple[str, ...]] = ("t_s", "x_m", "y_m", "z_m", "sigma_x_m", "sigma_y_m", "sigma_z_m")
    units: ClassVar[tuple[str, ...]] = ("m",) * 3
    fixes: ClassVar[frozenset[Gauge]] = frozenset(Gauge)

    t_s: float
    xyz_m: Vector
    sigma_m: float | Vector
    lever_arm_m: Vector = (0.0, 0.0, 0.0)  # the antenna in the camera's axes: x right, y down, z forward

    @property
    def sigmas(self) -> FloatArray:
        """Along the three axes, metres."""
        return np.broadcast_to(np.asarray(self.sigma_m, np.float64), (3,))

    def residual(self, T: FloatArray, shared: FloatArray) -> Residual:
        """Return predicted minus measured position, metres."""
        arm = np.asarray(self.lever_arm_m)
        return se3.rotation(T[0]) @ arm + se3.translation(T[0]) - np.asarray(self.xyz_m), point_jacobian(T[0], arm)

    @classmethod
    def of_row(cls, row: Sequence[float], mount: Mount) -> Self:
        """Make a reading of a line."""
        x, y, z = se3.translation(mount.T_cam_body).tolist()
        return cls(row[0], (row[1], row[2], row[3]), (row[4], row[5], row[6]), (x, y, z))

    @classmethod
    def simulate(cls, times_s: Sequence[float], T: FloatArray, sigma: float, rng: Generator | None = None) -> Self:
        """Make the reading that a true pose gives."""
        x, y, z = (se3.translation(T[0]) + noise(rng, sigma, 3)).tolist()
        return cls(times_s[0], (x, y, z), sigma)


@dataclass(frozen=True, slots=True)
class Height(Measurement):
    """Camera's z coordinate: barometer, the floor of a building."""

    kind: ClassVar[str] = "height"
    columns: ClassVar[tuple[str, ...]] = ("t_s", "z_m", "sigma_m")
    units: ClassVar[tuple[str, ...]] = ("m",)
    fixes: ClassVar[frozenset[Gauge]] = frozenset(Gauge)

    t_s: float
    z_m: float
    sigma_m: float

    def residual(self, T: FloatArray, shared: FloatArray) -> Residual:
        """Return predicted minus measured height, metres."""
        return T[0, 2, 3:] - self.z_m, point_jacobian(T[0], np.zeros(3))[2:]

    @classmethod
    def simulate(cls, times_s: Sequence[float], T: FloatArray, sigma: float, rng: Generator | None = None) -> Self:
        """Make the reading that a true pose gives."""
        return cls(times_s[0], float(T[0, 2, 3] + noise(rng, sigma, 1)[0]), sigma)


@dataclass(frozen=True, slots=True)
class Direction(Measurement):
    """A direction in the camera's axes, and the same one in the measurements' frame: gravity (down in both), north."""

    kind: ClassVar[str] = "direction"
    columns: ClassVar[tuple[str, ...]] = ("t_s", "bx", "by", "bz", "wx", "wy", "wz", "sigma_rad")
    units: ClassVar[tuple[str, ...]] = ("rad",) * 3
    fixes: ClassVar[frozenset[Gauge]] = frozenset({Gauge.ROTATION})

    t_s: float
    in_camera: Vector  # of any length, as the other
    in_world: Vector
    sigma_rad: float

    def residual(self, T: FloatArray, shared: FloatArray) -> Residual:
        """Return the difference of the two unit vectors, in the measurements' frame."""
        R, (d, known) = se3.rotation(T[0]), (np.asarray(v) / np.linalg.norm(v) for v in (self.in_camera, self.in_world))
        return R @ d - known, np.hstack((-R @ so3.hat(d), np.zeros((3, 3))))

    @classmethod
    def of_row(cls, row: Sequence[float], mount: Mount) -> Self:
        """Make a reading of a line."""
        x, y, z = (se3.rotation(mount.T_cam_body) @ np.asarray(row[1:4])).tolist()
        return cls(row[0], (x, y, z), (row[4], row[5], row[6]), row[7])

    @classmethod
    def simulate(cls, times_s: Sequence[float], T: FloatArray, sigma: float, rng: Generator | None = None) -> Self:
        """Make the reading of gravity, which points along minus z."""
        x, y, z = (so3.exp(noise(rng, sigma, 3)) @ se3.rotation(T[0]).T @ np.asarray(DOWN)).tolist()
        return cls(times_s[0], (x, y, z), DOWN, sigma)


@dataclass(frozen=True, slots=True)
class Distance(Measurement):
    """Straight line between two places of the camera: a tape measure, an odometer on a straight way."""

    kind: ClassVar[str] = "distance"
    columns: ClassVar[tuple[str, ...]] = ("t_a_s", "t_b_s", "distance_m", "sigma_m")
    units: ClassVar[tuple[str, ...]] = ("m",)
    fixes: ClassVar[frozenset[Gauge]] = frozenset({Gauge.SCALE})

    t_a_s: float
    t_b_s: float
    distance_m: float
    sigma_m: float

    def residual(self, T: FloatArray, shared: FloatArray) -> Residual:
        """Return predicted minus measured distance, metres."""
        d = se3.translation(T[1]) - se3.translation(T[0])
        length = float(np.linalg.norm(d))
        u, none = d / max(length, TINY), np.zeros(3)
        return np.array([length - self.distance_m]), np.hstack(
            (none, -u @ se3.rotation(T[0]), none, u @ se3.rotation(T[1]))
        )[None]

    @classmethod
    def simulate(cls, times_s: Sequence[float], T: FloatArray, sigma: float, rng: Generator | None = None) -> Self:
        """Make the reading that two true poses give."""
        length = float(np.linalg.norm(se3.translation(T[1]) - se3.translation(T[0])) + noise(rng, sigma, 1)[0])
        return cls(times_s[0], times_s[1], length, sigma)


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose(Measurement):
    """Motion of the body between two times: wheel odometry, or any other odometry."""

    kind: ClassVar[str] = "relative_pose"
    columns: ClassVar[tuple[str, ...]] = (
        *("t_a_s", "t_b_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "sigma_m", "sigma_rad"),
    )
    units: ClassVar[tuple[str, ...]] = MOTION_UNITS
    fixes: ClassVar[frozenset[Gauge]] = frozenset({Gauge.SCALE})

    t_a_s: float
    t_b_s: float
    T_a_b: FloatArray  # (4, 4): the body's second pose in its first, metres
    sigma_m: float
    sigma_rad: float
    mount: Mount = field(default_factory=Mount)

    @property
    def turn_rad(self) -> FloatArray:
        """Rotation vector of the body's motion."""
        return so3.log(se3.rotation(self.T_a_b))

    @property
    def distance_m(self) -> float:
        """Length of the motion."""
        return float(np.linalg.norm(se3.translation(self.T_a_b)))

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


@dataclass(frozen=True, slots=True)
class SamePlace(Measurement):
    """Two times at which the camera had one pose, up to the sigmas: a loop that a person has set."""

    kind: ClassVar[str] = "same_place"
    columns: ClassVar[tuple[str, ...]] = ("t_a_s", "t_b_s", "sigma_m", "sigma_rad")
    units: ClassVar[tuple[str, ...]] = MOTION_UNITS

    t_a_s: float
    t_b_s: float
    sigma_m: float
    sigma_rad: float

    def residual(self, T: FloatArray, shared: FloatArray) -> Residual:
        """Return the logarithm of the motion between the two poses."""
        return between(T, se3.IDENTITY, se3.IDENTITY)

    @classmethod
    def simulate(cls, times_s: Sequence[float], T: FloatArray, sigma: float, rng: Generator | None = None) -> Self:
        """Make the reading of two poses that are one; `sigma`: metres, and a tenth of it per radian."""
        return cls(times_s[0], times_s[1], sigma, 0.1 * sigma)


@dataclass(frozen=True, slots=True, eq=False)
class RotationRate(Measurement):
    """Turn of the body from one time to another, integrated from a gyroscope."""

    kind: ClassVar[str] = "rotation_rate"
    columns: ClassVar[tuple[str, ...]] = ("t_s", "wx_rad_s", "wy_rad_s", "wz_rad_s", "sigma_rad_s")
    units: ClassVar[tuple[str, ...]] = ("rad",) * 3
    shared_sigmas: ClassVar[tuple[float, ...]] = (BIAS_SIGMA_RAD_S,) * 3

    t_a_s: float
    t_b_s: float
    turn_rad: FloatArray  # (3,): rotation vector in the body's axes
    sigma_rad: float  # of the turn
    mount: Mount = field(default_factory=Mount)
    bias_effect_s: FloatArray | None = None
    """(3, 3): derivative of the turn's right perturbation by minus the bias; None: a short turn."""

    @property
    def times_s(self) -> tuple[float, ...]:
        """Times of the two poses."""
        return self.t_a_s, self.t_b_s

    def residual(self, T: FloatArray, shared: FloatArray) -> Residual:
        """Return the rotation vector of the turn that is left over."""
        B = se3.rotation(self.mount.T_cam_body)
        effect = so3.IDENTITY * (self.t_b_s - self.t_a_s) if self.bias_effect_s is None else self.bias_effect_s
        unbiased = so3.exp(self.turn_rad) @ so3.exp(-effect @ shared)
        R_b_a = B.T @ se3.rotation(T[1]).T @ se3.rotation(T[0]) @ B
        r = so3.log((R_b_a @ unbiased).T)
        J_r = so3.right_jacobian_inverse(r)
        J = np.zeros((3, 15))
        J[:, 0:3] = -J_r @ R_b_a @ B.T
        J[:, 6:9] = J_r @ B.T
        # r = log(exp(effect b) turn^-1 R_a_b): a change of the bias stands at the left.
        J[:, 12:] = so3.left_jacobian_inverse(r) @ so3.left_jacobian(effect @ shared) @ effect
        return r, J

    @classmethod
    def of_row(cls, row: Sequence[float], mount: Mount) -> Self:
        """Make a reading of a line: the turn within a second at this rate, until `integrate` knows its length."""
        return cls(row[0], row[0], np.asarray(row[1:4], np.float64), row[4], mount)

    @classmethod
    def simulate(cls, times_s: Sequence[float], T: FloatArray, sigma: float, rng: Generator | None = None) -> Self:
        """Make the turn between two true poses."""
        turn = so3.exp(so3.log(se3.rotation(T[0]).T @ se3.rotation(T[1]))) @ so3.exp(noise(rng, sigma, 3))
        return cls(times_s[0], times_s[1], so3.log(turn), sigma)

    @classmethod
    def integrate(cls, readings: Sequence[Self], cuts_s: FloatArray) -> list[Self]:
        """Return the turns between neighbouring times, where readings of one instant cover all of the way.

        - `readings`: of lines: `t_a_s` equals `t_b_s`. Others are returned as they are.
        - `cuts_s` (K,): ascending, on the sensor's clock.
        """
        done = [r for r in readings if r.t_b_s > r.t_a_s]
        raw = sorted((r for r in readings if r.t_b_s == r.t_a_s), key=lambda r: r.t_a_s)
        if len(raw) < 2:
            return done
        t, w = np.array([r.t_a_s for r in raw]), np.array([r.turn_rad for r in raw])
        for a, b in zip(cuts_s[:-1].tolist(), cuts_s[1:].tolist(), strict=True):
            first, last = np.searchsorted(t, (a, b))
            if first == 0 or last == len(t):
                continue
            inside = np.concatenate(([a], t[first:last], [b]))
            if np.diff(t[first - 1 : last + 1]).max() > MAX_GAP_S or b <= a:
                continue
            rates = np.stack([np.interp((inside[:-1] + inside[1:]) / 2, t, w[:, i]) for i in range(3)], 1)
            steps = np.diff(inside)
            R, effect = np.eye(3), np.zeros((3, 3))
            for step, turn in zip(steps.tolist(), so3.exp(rates * steps[:, None]), strict=True):
                R = R @ turn
                effect = turn.T @ effect + step * so3.IDENTITY
            sigma = raw[first].sigma_rad * float(np.sqrt((steps**2).sum()))
            done.append(cls(a, b, so3.log(R), sigma, raw[first].mount, effect))
        return done
