"""The motion between the last two posed frames, and how far beyond them it says something."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dualslam.core.geometry import se3
from dualslam.core.noise_model import ROBUST_N
from dualslam.core.types import FloatArray, Track, View
from dualslam.map.submap import NO_LANDMARK

MAX_EXTRAPOLATION = 3.0
"""Intervals for which the motion between the last two frames says something."""
STEADY_S = 1 / 6
"""For so long it says something in any case: what carries a camera does not turn round in less. Up to four frames of
30 Hz that came too late are no gap, whatever the interval before them was."""
MIN_SHARE = 0.2
"""Of the usual interval: a nearer stamp tells when a frame came, too late, and its motion took the usual time. Where up
to three of four frames are left out, the next one is still a quarter away."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Constant velocity in the camera's frame."""

    xi: FloatArray | None = None
    """(6,): the motion from one frame to the next; None: none is known, and the camera is taken to be at rest."""
    interval_s: float = 0.0
    """The time that it took; negative where frames come in reverse. At rest, the shortest time between two keyframes:
    no frame of a slow sequence is a gap."""
    recent_s: tuple[float, ...] = ()  # the last intervals, as they were stamped
    repeated_s: float = 0.0  # for how long the same image has come again

    def next(self, before: Track, after: Track) -> Motion:
        """Return the motion that follows this one, from one track to the next.

        An image that comes again shows no motion: a video of another rate, or a camera that has no new one yet.
        """
        interval_s = after.view.timestamp_s - before.view.timestamp_s
        repeated_s = self.repeated_s + abs(interval_s)
        if self.xi is not None and repeated_s < STEADY_S and _show_the_same(before, after):
            return replace(self, repeated_s=repeated_s)
        recent_s = (*self.recent_s, interval_s)[-ROBUST_N:]
        usual_s = sorted(recent_s, key=abs)[(len(recent_s) - 1) // 2]
        if abs(interval_s) < MIN_SHARE * abs(usual_s):
            interval_s = usual_s
        return Motion(se3.log(after.T_cam_submap @ se3.inverse(before.T_cam_submap)), interval_s, recent_s)

    def scaled(self, scale: float) -> Motion:
        """Return the motion in another unit."""
        if self.xi is None:
            return self
        return replace(self, xi=np.concatenate([self.xi[:3], scale * self.xi[3:]]))

    def predict(self, last: Track, timestamp_s: float) -> FloatArray:
        """Return the pose `T_cam_submap` at a time: the motion scaled to the time that has passed since a track."""
        if self.xi is None:
            return last.T_cam_submap
        # Far beyond the measured interval (frames were lost) the velocity says little.
        n_intervals = np.clip(self._n_intervals(last, timestamp_s), 0.0, self._max_extrapolation)
        return se3.exp(self.xi * n_intervals) @ last.T_cam_submap

    def lies_beyond_gap(self, last: Track, view: View) -> bool:
        """Whether so much time has passed since a track that the motion does not lead to a view; at rest, too."""
        if self.xi is None:
            return abs(view.timestamp_s - last.view.timestamp_s) > max(STEADY_S, self.interval_s)
        return self._n_intervals(last, view.timestamp_s) > self._max_extrapolation

    @property
    def _max_extrapolation(self) -> float:
        dt = abs(self.interval_s)
        return max(MAX_EXTRAPOLATION, STEADY_S / dt) if dt > 0 else MAX_EXTRAPOLATION

    def _n_intervals(self, last: Track, timestamp_s: float) -> float:
        dt = self.interval_s
        return (timestamp_s - last.view.timestamp_s) / dt if dt != 0 else 1.0


def _show_the_same(a: Track, b: Track) -> bool:
    """Whether most of the landmarks that two frames share lie at the very same pixels in both."""
    shared, in_a, in_b = np.intersect1d(a.landmark_ids, b.landmark_ids, return_indices=True)
    still = (a.view.features.uv_px[in_a] == b.view.features.uv_px[in_b]).all(axis=1)[shared != NO_LANDMARK]
    return 2 * int(np.count_nonzero(still)) > len(still)
