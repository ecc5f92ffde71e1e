"""Measurements made from true poses, with seeds, sigmas, outliers and clocks that are off: for tests and benchmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualslam.core.geometry import se3, so3
from dualslam.core.metric_problem import MeasurementRow, RowSource
from dualslam.core.trajectory import Trajectory
from dualslam.core.types import FloatArray


@dataclass(frozen=True, slots=True)
class Receiver:
    """A simulated satellite receiver.

    Attributes
    ----------
    sigma_m, rate_hz : float
    outlier_share, outlier_m : float
        Share of the positions that are so far off, in a random direction.
    clock_offset_s : float
        What has to be added to its times.
    seed : int
    """

    sigma_m: float = 1.0
    rate_hz: float = 1.0
    outlier_share: float = 0.0
    outlier_m: float = 30.0
    clock_offset_s: float = 0.0
    seed: int = 0

    def positions(self, truth: Trajectory) -> RowSource:
        """Return positions along true poses (metres, ascending in time)."""
        rng = np.random.default_rng(self.seed)
        t = truth.timestamps_s
        times = np.arange(t[0] + rng.random() / self.rate_hz, t[-1], 1.0 / self.rate_hz)
        xyz = poses_at(truth, times)[:, :3, 3] + rng.normal(0.0, self.sigma_m, (len(times), 3))
        bad = rng.permutation(len(times))[: round(self.outlier_share * len(times))]
        away = rng.normal(size=(len(bad), 3))
        xyz[bad] += self.outlier_m * away / np.linalg.norm(away, axis=1, keepdims=True)
        stated = [self.sigma_m] * 3
        rows = [
            MeasurementRow("position", (float(a - self.clock_offset_s), *p, *stated), "simulated")
            for a, p in zip(times, xyz.tolist(), strict=True)
        ]
        return RowSource("simulated GPS", rows)


@dataclass(frozen=True, slots=True)
class Gyroscope:
    """A simulated gyroscope: white noise of each reading, a constant bias, turned axes."""

    sigma_rad_s: float = 0.005
    bias_rad_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rate_hz: float = 100.0
    turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seed: int = 0

    def rates(self, truth: Trajectory) -> RowSource:
        """Return rates of turn; `turn_rad` is the rotation vector from its axes to the camera's."""
        rng = np.random.default_rng(self.seed)
        t = truth.timestamps_s
        times = np.arange(t[0], t[-1], 1.0 / self.rate_hz)
        T = poses_at(truth, np.append(times, min(times[-1] + 1.0 / self.rate_hz, t[-1])))
        in_camera = so3.log(T[:-1, :3, :3].swapaxes(1, 2) @ T[1:, :3, :3]) * self.rate_hz
        w = in_camera @ so3.exp(self.turn_rad) + self.bias_rad_s + rng.normal(0, self.sigma_rad_s, in_camera.shape)
        middle = times + 0.5 / self.rate_hz
        rows = [
            MeasurementRow("rotation_rate", (float(a), *rate, self.sigma_rad_s), "simulated")
            for a, rate in zip(middle, w.tolist(), strict=True)
        ]
        return RowSource("simulated gyroscope", rows)


def poses_at(truth: Trajectory, times_s: FloatArray) -> FloatArray:
    """Return true poses (M, 4, 4), interpolated at constant rate between two of them."""
    t, T = truth.timestamps_s, truth.T_world_cam
    after = np.clip(np.searchsorted(t, times_s, side="right"), 1, len(t) - 1)
    share = (times_s - t[after - 1]) / (t[after] - t[after - 1])
    xi = se3.log(se3.inverse(T[after - 1]) @ T[after])
    return np.asarray(T[after - 1] @ se3.exp(share[:, None] * xi))


def csv_text(source: RowSource) -> str:
    """Return a source as the CSV that ``--measurements`` reads."""
    lines = [f"{row.kind},{','.join(f'{v:.9g}' for v in row.values)}" for row in source.rows]
    return "# simulated\n" + "\n".join(lines) + "\n"
