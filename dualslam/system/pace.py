"""Whether the system keeps up with its camera, and what it leaves out where it does not; only real time has a pace.

The tracking is behind if frames are processed after their time. The back end is behind if more keyframes wait for its
graph than it can catch up on. In either case a keyframe that is due but not urgent is put off until both have caught
up. While there is no map, a start is looked for beside the frames (`workers/start_beside.py`), or, without processes,
by one pair of frames at a time: a start that comes late costs more than frames that are dropped.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

BEHIND_S = 1 / 30
"""A frame that is a frame of 30 Hz late was held up by more than chance: the step before it was too long."""
FAR_BEHIND_KEYFRAMES = 30
"""Keyframes that it may not know in real time: those of a second in which each frame is one, as long as a batch over a
full submap takes. Below that its lag ends by itself, since five keyframes at once cost a graph half of five one by one.
In a fast turn, where the lag arises, a missing keyframe loses the track."""
MAX_PUT_OFF = 5
"""Frames by which a keyframe is put off at most. At 30 Hz that is a sixth of a second. It suffices to work off the
delay of a keyframe and a relinearisation, and the view changes by a few degrees at most."""
URGENT_TIMES = 2
"""A frame that tracks fewer than so many times the landmarks of a weak track needs new ones now, or is lost."""


@dataclass(slots=True)
class PaceStatistics:
    """Counts of the work left out."""

    put_off: int = 0  # frames at which a keyframe was due and did not come
    behind: int = 0  # frames that were looked at while the system was behind
    max_lag_keyframes: int = 0  # keyframes that the graph beside did not know yet, at most


class Pace:
    """Knows how late the frames are, and how many keyframes the graph beside does not know yet.

    - `in_real_time`: whether frames come by a clock.
    - `late_s`: how late the frame in hand is (s); 0 without a clock.
    - `clock`: seconds; measures by how much background results hold a frame up.
    """

    def __init__(self) -> None:
        self.statistics = PaceStatistics()
        self.clock: Callable[[], float] = time.perf_counter
        self.in_real_time = False
        self.late_s = 0.0
        self._lag = 0
        self._n_put_off = 0

    def note(self, late_s: float) -> None:
        """Note, before a frame is looked at, how late it is: real time has begun with the first."""
        self.in_real_time = True
        self.late_s = late_s
        self.statistics.behind += self.behind

    def hold_up(self, seconds: float) -> None:
        """Note by how much more a frame is late, since background results came in before it."""
        self.late_s += seconds

    def note_lag(self, n_keyframes: int) -> None:
        """Note how many keyframes the graph beside does not know yet."""
        self._lag = n_keyframes
        self.statistics.max_lag_keyframes = max(self.statistics.max_lag_keyframes, n_keyframes)

    @property
    def behind(self) -> bool:
        """Whether tracking or back end have something to catch up on."""
        return self.in_real_time and (self.late_s > BEHIND_S or self._lag > FAR_BEHIND_KEYFRAMES)

    def puts_off(self, n_tracked: int, n_weak: int) -> bool:
        """Whether a keyframe that is due is put off to a later frame.

        - `n_tracked`: landmarks that the frame tracks.
        - `n_weak`: so few are a weak track (`KeyframeConfig.weak_landmarks`).
        """
        if n_tracked < URGENT_TIMES * n_weak:
            return False
        if not self.behind or self._n_put_off >= MAX_PUT_OFF:
            self._n_put_off = 0
            return False
        self._n_put_off += 1
        self.statistics.put_off += 1
        return True
