"""Progress of reverse tracking, for onlookers: it never changes the walk.

News are whole, not what is new since the last: one that is lost matters to nobody.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualslam.core.geometry import se3
from dualslam.core.types import Failure, FloatArray, Track, View

EVERY_S = 0.15
"""Between two news: a little less than between two looks of the live view, of which there are five a second."""
MAX_POINTS = 128
"""Of a way: to the eye it is the same as one of all frames, and it stays below 2 kB in a pipe."""
REGISTRATION = "registration"
"""`WalkNews.attempt` of frames that are registered at the end of a run, in any order."""


@dataclass(frozen=True, slots=True, eq=False)
class WalkNews:
    """How far reverse tracking, or registration at the end of a run, has come."""

    submap_id: int  # from which it walks, and in whose frame its poses are
    attempt: str
    frame: int  # at which it is
    is_posed: bool  # whether that frame has a pose; if not, the walk looks for a way across a gap
    n_posed: int  # frames that have one
    T_submap_cam: NDArray[np.float32] | None  # (4, 4): of the last frame that has a pose
    way: NDArray[np.float32]
    """(N, 3) float32: where the camera was, the earliest frame first: `MAX_POINTS` at most, evenly."""


class WalkTrace:
    """Where one attempt at a walk has been: from the keyframe `newest_id`, whose centre is `started_from` (3,)."""

    def __init__(self, submap_id: int, attempt: str, newest_id: int, started_from: FloatArray) -> None:
        self._submap_id, self._attempt = submap_id, attempt
        self._centres = {newest_id: started_from}
        self._frame, self._is_posed = newest_id, True
        self._T_submap_cam: FloatArray | None = None
        self._told_s = -np.inf

    def note(self, view: View, track: Track | Failure) -> None:
        """Note what has become of a frame."""
        self._frame, self._is_posed = view.index, bool(track)
        if isinstance(track, Track):
            self._T_submap_cam = se3.inverse(track.T_cam_submap)
            self._centres[view.index] = self._T_submap_cam[:3, 3]

    def note_confirmed(self, track: Track) -> None:
        """Note that an earlier frame, which had no pose then, has one after all."""
        self._centres[track.view.index] = se3.inverse(track.T_cam_submap)[:3, 3]

    def news(self) -> WalkNews | None:
        """Return how far the walk has come; None right after an earlier report."""
        now = time.monotonic()
        if now - self._told_s < EVERY_S:
            return None
        self._told_s = now
        frames = sorted(self._centres)
        shown = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), MAX_POINTS)).round().astype(int))
        T = self._T_submap_cam
        return WalkNews(
            self._submap_id,
            self._attempt,
            self._frame,
            self._is_posed,
            len(frames) - 1,
            None if T is None else T.astype(np.float32),
            np.array([self._centres[frames[n]] for n in shown], np.float32),
        )


class WalkWatch:
    """Passes on the reports of walks, in the process that tracks, to all onlookers."""

    def __init__(self) -> None:
        self._told: list[Callable[[WalkNews], None]] = []

    def add(self, on_walk: Callable[[WalkNews], None]) -> None:
        """Tell one more from now on."""
        self._told.append(on_walk)

    def __call__(self, news: WalkNews) -> None:
        """Tell all."""
        for on_walk in self._told:
            on_walk(news)
