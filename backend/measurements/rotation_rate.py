"""Rate of turn: a gyroscope. Its readings are integrated between nodes; their bias is a shared unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np
from numpy.random import Generator

from dualslam.backend.measurements.base import Measurement, Mount, Residual, noise
from dualslam.core.geometry import se3, so3
from dualslam.core.types import FloatArray

BIAS_SIGMA_RAD_S = 0.05
"""Of a phone's gyroscope that was never calibrated: 3 degrees a second."""
MAX_GAP_S = 0.1
"""Between two readings: across a longer gap nothing is integrated."""


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
            rates = np.stack([np.interp(0.5 * (inside[:-1] + inside[1:]), t, w[:, i]) for i in range(3)], 1)
            steps = np.diff(inside)
            R, effect = np.eye(3), np.zeros((3, 3))
            for step, turn in zip(steps.tolist(), so3.exp(rates * steps[:, None]), strict=True):
                R = R @ turn
                effect = turn.T @ effect + step * so3.IDENTITY
            sigma = raw[first].sigma_rad * float(np.sqrt((steps**2).sum()))
            done.append(cls(a, b, so3.log(R), sigma, raw[first].mount, effect))
        return done
