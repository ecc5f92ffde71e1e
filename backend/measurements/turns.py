"""The camera's turns while a run goes on, from a gyroscope or an odometry (`dualslam.core.motion_prior`)."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dualslam.backend.measurements.rotation_rate import MAX_GAP_S
from dualslam.backend.measurements.start import MAX_OFFSET_S, OFFSET_STEP_S, beats_chance, mount_of
from dualslam.core.geometry import so3
from dualslam.core.motion_prior import Turn
from dualslam.core.types import FloatArray

MIN_FRAMES, MAX_FRAMES = 30, 480
"""Posed frames from which a sensor is fitted: again after each doubling, then by the last so many."""
MAX_STEP_S = 1.0
"""Between two posed frames that a sensor is fitted to."""
KEPT_S = 600.0
"""Of readings that come with the frames; recovery asks for less."""
MOUNT_SIGMA = 0.02
"""Radian a radian of turn: one degree of the mount."""
MAX_UNEXPLAINED = 0.5
"""Share of the camera's turns that a sensor may leave over and still be of this camera (medians)."""
STILL_RAD_S = 0.02
"""Below it a camera hardly turns, and tells nothing of a sensor but its bias."""


@dataclass(frozen=True, slots=True, eq=False)
class KnownTurns:
    """Implements `MotionPrior`: rates of turn, each for an interval, in the camera's axes and on its clock."""

    begin_s: FloatArray  # (N,): ascending; intervals do not overlap
    end_s: FloatArray  # (N,)
    rates: FloatArray  # (N, 3): rad/s
    sigmas: FloatArray  # (N,): of the rates
    bias_sigma: float

    def turn(self, t_a_s: float, t_b_s: float) -> Turn | None:
        """Return the turn between two times; None where readings do not cover all of the way."""
        a, b = min(t_a_s, t_b_s), max(t_a_s, t_b_s)
        rows = slice(int(np.searchsorted(self.end_s, a, "right")), int(np.searchsorted(self.begin_s, b)))
        begin, end = np.maximum(self.begin_s[rows], a), np.minimum(self.end_s[rows], b)
        steps = end - begin
        if len(steps) == 0 or b - a - float(steps.sum()) > 1e-6 + 1e-3 * (b - a):
            return None
        R = np.eye(3)
        for step in so3.exp(self.rates[rows] * steps[:, None]):
            R = R @ step
        noise = float(np.linalg.norm(self.sigmas[rows] * steps))
        mount = MOUNT_SIGMA * float(so3.rotation_angle(R))
        sigma = float(np.linalg.norm((noise, self.bias_sigma * (b - a), mount)))
        return Turn(R if t_a_s <= t_b_s else R.T, sigma)


class TurnPrior:
    """Implements `LivePrior` by the readings of one source, those of other kinds among them.

    It knows nothing before the frames have confirmed it: clock, mount and bias are fitted to their turns.
    """

    def __init__(self, readings: Iterable[Any] = (), has_clock: bool = True) -> None:
        self._fit: _Fit | None = None
        self._known: KnownTurns | None = None
        self._rows = np.zeros((0, 6))  # begin, end, rate, sigma; by the sensor's clock, in its axes
        self._has_clock, self._is_mounted, self._min_step_s = has_clock, False, 0.0
        self._seen: deque[tuple[float, float, FloatArray]] = deque(maxlen=MAX_FRAMES)
        self._n_seen, self._due = 0, MIN_FRAMES
        self._last: tuple[float, FloatArray, int] | None = None
        self.add(readings)

    def add(self, readings: Iterable[Any]) -> None:
        """Take readings."""
        turns = [r for r in readings if hasattr(r, "turn_rad") and len(r.times_s) == 2]
        at_once = [r for r in turns if r.times_s[0] == r.times_s[1]]  # of a gyroscope, which knows it better
        rows = []
        for r in at_once or turns:
            (a, b), R = r.times_s, r.mount.T_cam_body[:3, :3]
            reach, length = (0.5 * MAX_GAP_S, 1.0) if a == b else (0.0, b - a)
            rows.append((a - reach, b + reach, *(R @ r.turn_rad / length), r.sigma_rad / length))
            self._is_mounted = r.mount.is_given
        if not rows:
            return
        older = self._rows[self._rows[:, 0] > rows[-1][0] - KEPT_S]
        found = np.concatenate((older, rows))
        self._rows, self._known = found[found[:, 0].argsort(kind="stable")], None
        lengths = self._rows[:, 1] - self._rows[:, 0]
        self._min_step_s = 0.0 if at_once else 2.0 * float(np.median(lengths))  # a turn within a reading is not known

    @property
    def known(self) -> KnownTurns | None:
        """What it knows now, which changes no more; None before it has seen enough frames."""
        if self._known is None and self._fit is not None:
            begin, end = self._intervals()
            fit = self._fit
            rates = (self._rows[:, 2:5] - fit.bias) @ fit.R.T
            at = begin + fit.offset_s, end + fit.offset_s
            self._known = KnownTurns(*at, rates, self._rows[:, 5], fit.bias_sigma)
        return self._known

    def turn(self, t_a_s: float, t_b_s: float) -> Turn | None:
        """Return the turn between two times; None where it is not known."""
        known = self.known
        return None if known is None else known.turn(t_a_s, t_b_s)

    def note(self, timestamp_s: float, R_map_cam: FloatArray, submap_id: int) -> None:
        """Learn from a posed frame."""
        last = self._last
        if last is not None and last[2] == submap_id and abs(timestamp_s - last[0]) < 0.999 * self._min_step_s:
            return
        self._last = timestamp_s, R_map_cam, submap_id
        if len(self._rows) == 0 or last is None or last[2] != submap_id or abs(timestamp_s - last[0]) > MAX_STEP_S:
            return
        rate = so3.log(last[1].T @ R_map_cam) / (timestamp_s - last[0])
        self._seen.append((min(last[0], timestamp_s), max(last[0], timestamp_s), rate))
        self._n_seen += 1
        if self._n_seen >= self._due:
            self._fit, self._known = self._fitted(), None
            self._due = self._n_seen + min(self._n_seen, MAX_FRAMES)

    def _intervals(self) -> tuple[FloatArray, FloatArray]:
        """Return the beginnings and ends (N,) of the readings, which meet where they would overlap."""
        begin, end = self._rows[:, 0].copy(), self._rows[:, 1].copy()
        overlaps, meet = end[:-1] > begin[1:], 0.5 * (begin[1:] + end[:-1])
        begin[1:][overlaps], end[:-1][overlaps] = meet[overlaps], meet[overlaps]
        return begin, end

    def _fitted(self) -> _Fit | None:
        """Fit clock, mount and bias; None where the sensor does not agree with the camera, or its axes are unknown."""
        seen = np.array([rate for _, _, rate in self._seen])
        times = np.array([(a, b) for a, b, _ in self._seen])
        begin, end = self._intervals()
        edges = np.column_stack((begin, end)).ravel()
        turned = np.repeat((self._rows[:, 2:5] * (end - begin)[:, None]).cumsum(axis=0), 2, axis=0)
        turned[::2] = np.vstack((np.zeros(3), turned[1:-1:2]))
        covered = np.repeat((end - begin).cumsum(), 2)
        covered[::2] = np.append(0.0, covered[1:-1:2])

        def measured(offset_s: float) -> tuple[FloatArray, FloatArray]:
            """Return the sensor's mean rates (K, 3) over the frames' intervals, and which are known."""
            at = times - offset_s
            by = np.stack([np.interp(at[:, 1], edges, c) - np.interp(at[:, 0], edges, c) for c in (*turned.T, covered)])
            length = np.diff(times, axis=1)[:, 0]
            return (by[:3] / length).T, by[3] > 0.99 * length

        def fit(offset_s: float) -> _Fit:
            m, known = measured(offset_s)
            if known.sum() < MIN_FRAMES // 2:
                return _Fit(offset_s)
            m, s = m[known], seen[known]
            R = np.eye(3) if self._is_mounted else mount_of(m, s)
            if R is None or np.linalg.det(R) < 0:
                return _Fit(offset_s)
            bias = np.median(m - s @ R, axis=0)
            left = np.abs(m - s @ R - bias)
            sigma = 1.25 * 1.4826 * float(np.median(left)) / np.sqrt(len(left))
            return _Fit(offset_s, float(np.median(np.linalg.norm(left, axis=1))), R, bias, sigma)

        best = fit(0.0)
        if self._has_clock:
            offsets = np.arange(-MAX_OFFSET_S, MAX_OFFSET_S + 1e-9, OFFSET_STEP_S)
            coarse = min(map(fit, offsets.tolist()), key=lambda found: found.left_rad_s)
            offsets = coarse.offset_s + np.arange(-12, 13) / 12 * OFFSET_STEP_S
            fine = min(map(fit, offsets.tolist()), key=lambda found: found.left_rad_s)
            best = fine if beats_chance(fine.left_rad_s, best.left_rad_s, len(seen) - 1.0) else best
        size = float(np.median(np.linalg.norm(seen, axis=1)))
        return None if best.left_rad_s > max(MAX_UNEXPLAINED * size, STILL_RAD_S) else best


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A sensor's clock, mount and bias, and the median of what they leave over."""

    offset_s: float
    left_rad_s: float = np.inf
    R: FloatArray = field(default_factory=lambda: np.eye(3))
    bias: FloatArray = field(default_factory=lambda: np.zeros(3))
    bias_sigma: float = np.inf
