"""Motion test inside one map: once tracking has found its place again beyond a gap, the camera's motion must agree."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dualslam.atlas.record import FrameStamp, Record
from dualslam.atlas.trajectory import Path
from dualslam.core.noise_model import MISSING_INTERVALS
from dualslam.core.types import Failure
from dualslam.linking.join_test import judge_motion
from dualslam.linking.motion import WINDOW_FRAMES, WINDOW_S, step_motions
from dualslam.map.submap import Submap

HISTORY_S = 30.0
"""Before the gap: what is asked about the camera's motion."""


@dataclass(frozen=True, slots=True)
class Break:
    """Where a map is broken: the first frame that it poses wrongly, and why."""

    first: int
    failure: Failure


class MotionWatch:
    """Applies the motion test to a gap, a moment after tracking has found its place again beyond it."""

    def __init__(self) -> None:
        self._first_beyond: FrameStamp | None = None  # the gap to be tested ends there

    def begin(self, at: FrameStamp) -> None:
        """Test the gap before a frame that was posed after a loss."""
        self._first_beyond = at

    def end(self) -> None:
        """Forget the gap."""
        self._first_beyond = None

    def judge(self, at: FrameStamp, wide: bool, record: Record, submap: Submap) -> Break | None:
        """Note a posed frame, and return where the map is broken, once the velocity beyond the gap is known.

        - `wide`: whether it was found beyond a gap.
        - `submap`: in which it was posed.
        """
        if wide and self._first_beyond is None:
            self._first_beyond = at
        if self._first_beyond is None:
            return None
        poses = sorted((p for p in record.own_poses() if p.submap_id == submap.id), key=lambda pose: pose.index)
        times_s = np.array([pose.timestamp_s for pose in poses])
        place = int(np.searchsorted([pose.index for pose in poses], self._first_beyond.index))
        if place == 0:
            self.end()  # this run has posed no frame in this map before
        if place == 0 or place == len(poses):
            return None
        usual_s = float(np.median(np.abs(np.diff(times_s))))
        if abs(at.timestamp_s - self._first_beyond.timestamp_s) < max(WINDOW_S, WINDOW_FRAMES * usual_s):
            return None
        self.end()
        # Reverse tracking may have posed frames before the first one: the gap is before these.
        missing = np.flatnonzero(np.abs(np.diff(times_s[: place + 1])) > MISSING_INTERVALS * usual_s)
        if not len(missing):
            return None
        last_before = poses[int(missing[-1])]
        since_s = [abs(pose.timestamp_s - last_before.timestamp_s) for pose in poses]
        recent = [p for p, s in zip(poses, since_s, strict=True) if p.index > last_before.index or s <= HISTORY_S]
        path = Path.of(recent, submap)
        path = replace(path, refound=record.are_refound(path.index.tolist()))
        gap = np.array([np.searchsorted(path.index, last_before.index)])
        refused = judge_motion(step_motions(path, gap, path.take(path.index <= last_before.index))).refusal()
        return None if refused is None else Break(poses[int(missing[-1]) + 1].index, refused)
