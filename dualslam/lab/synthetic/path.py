"""Where the camera is, as a smooth function of time: a drive along a road, a walk through a room."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from dualslam.core.types import FloatArray
from dualslam.lab.synthetic.road import Road


class Sway:
    """A smooth random motion: a sum of sinusoids with unrelated periods.

    Parameters
    ----------
    rng : numpy Generator
    amplitudes : (D,)
        Standard deviation of each of the D outputs.
    frequency_hz : (low, high)
    """

    def __init__(self, rng: np.random.Generator, amplitudes: list[float], frequency_hz: tuple[float, float]) -> None:
        n_waves = 4
        self._scale = np.array(amplitudes)[:, None] * np.sqrt(2 / n_waves)
        self._omega = 2 * np.pi * rng.uniform(*frequency_hz, (len(amplitudes), n_waves))
        self._phase = rng.uniform(0, 2 * np.pi, (len(amplitudes), n_waves))

    def __call__(self, t_s: float) -> FloatArray:
        """Return the sum of the waves at a time."""
        return np.asarray((self._scale * np.sin(self._omega * t_s + self._phase)).sum(1))


def pose(position: FloatArray, yaw_rad: float, pitch_rad: float, roll_rad: float) -> FloatArray:
    """Return `T_world_cam` (4, 4): yaw from z towards x, then pitch (looking up is positive), then roll."""
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3] = Rotation.from_euler("YXZ", [yaw_rad, pitch_rad, roll_rad]).as_matrix()
    T_world_cam[:3, 3] = position
    return T_world_cam


class Drive:
    """A car on the right-hand lane of a road; slower in bends, with the body's pitch, roll and bob.

    Parameters
    ----------
    road : Road
    rng : numpy Generator
    duration_s : float
    speed_m_s : float
        On straights.
    """

    def __init__(self, road: Road, rng: np.random.Generator, duration_s: float, speed_m_s: float) -> None:
        self._road = road
        # Exactly reproducible: the way driven is the integral of the speed, tabulated once.
        dt = 0.05
        t = np.arange(0, duration_s + 2 + dt, dt)
        s = np.zeros(len(t))
        for i in range(1, len(t)):
            turn = abs(float(road.heading(s[i - 1] + 8) - road.heading(s[i - 1])))
            s[i] = s[i - 1] + speed_m_s * max(0.45, 1 - 1.6 * turn) * dt
        self._way = CubicSpline(
            t, np.convolve(np.pad(s, 10, mode="reflect", reflect_type="odd"), np.ones(21) / 21, "valid")
        )
        self._lateral = Sway(rng, [0.15], (0.03, 0.09))
        self._body = Sway(rng, [0.0035, 0.004, 0.002, 0.012], (0.5, 1.6))

    def T_world_cam(self, t_s: float) -> FloatArray:
        """Return the pose (4, 4) at time `t_s`."""
        s = float(self._way(t_s))
        pitch, roll, yaw, bob = self._body(t_s)
        x, z = self._road.beside(s, 1.2 + self._lateral(t_s)[0])
        # The car's nose: towards a point some metres ahead on the same lane.
        ahead = self._road.beside(s + 4.0, 1.2 + self._lateral(t_s)[0])
        heading = float(np.arctan2(ahead[0] - x, ahead[1] - z))
        return pose(np.array([x, -1.65 + bob, z]), heading + yaw, pitch - 0.01, roll)


class Walk:
    """A hand-held camera carried round the middle of a room, looking across it.

    Parameters
    ----------
    rng : numpy Generator
    duration_s : float
    radii_m : (2,)
        Of the ellipse walked, along x and z, around the origin.
    """

    def __init__(self, rng: np.random.Generator, duration_s: float, radii_m: tuple[float, float]) -> None:
        step_s = 1.6
        n = int(np.ceil(duration_s / step_s)) + 4
        angle = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.uniform(0.08, 0.5, n))
        distance = rng.uniform(0.75, 1.0, n)
        knots = np.stack(
            [
                np.sin(angle) * radii_m[0] * distance,
                -rng.uniform(1.4, 1.65, n),
                np.cos(angle) * radii_m[1] * distance,
                angle + np.pi + rng.uniform(-0.45, 0.45, n),
                rng.uniform(-0.45, -0.05, n),
                rng.normal(0, 0.06, n),
            ],
            1,
        )
        self._spline = CubicSpline((np.arange(n) - 1) * step_s, knots)
        self._steps = Sway(rng, [0.006, 0.009, 0.006, 0.006, 0.006, 0.005], (0.7, 2.2))

    def T_world_cam(self, t_s: float) -> FloatArray:
        """Return the pose (4, 4) at time `t_s`."""
        state = self._spline(t_s) + self._steps(t_s)
        return pose(state[:3], *state[3:])
