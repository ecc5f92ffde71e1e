"""When the frames of a run in real time are due, and which of them are dropped."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from dualslam.core.errors import InputError
from dualslam.core.types import Frame
from dualslam.io.read_ahead import read_ahead

MAX_LATE_S = 1 / 15
"""So late a frame may be while the next one waits: two frames of a camera at 30 Hz, which most often are what a
keyframe takes more than other frames, and are caught up on after it. At 10 Hz a frame that the next one has overtaken
is later."""
CATCH_UP_S = 1.0
"""Who has not been in time for so long does not catch up: the newest frame is then the one to look at."""
LATE_S = 2e-3
"""What a sleeping process wakes up too late by is no lateness of ours."""


class Schedule:
    """When frames are due: as far after the first one as their timestamps are."""

    def __init__(self, clock: Callable[[], float], sleep: Callable[[float], None]) -> None:
        self._clock = clock
        self._sleep = sleep
        self._first_s = 0.0
        self._began = 0.0
        self._in_time_at = 0.0
        self.n_late = 0

    def late_s(self, frame: Frame, now: float) -> float:
        """Return how long ago a frame was due."""
        # Absolute: a sequence that is read in reverse runs at the same rate.
        return now - self._began - abs(frame.timestamp_s - self._first_s)

    def hand_out(self, frames: Iterator[Frame], dropped: list[tuple[int, float]]) -> Iterator[Frame]:
        """Yield each frame when its time has come, and note as dropped those that came too late."""
        frame = next(frames, None)
        if frame is None:
            return
        self._first_s, self._began = frame.timestamp_s, self._clock()
        self._in_time_at = self._began
        while frame is not None:
            broken: InputError | None = None
            try:
                upcoming = next(frames, None)
            except InputError as error:  # after the frame in hand
                upcoming, broken = None, error
            now = self._clock()
            late_s = self.late_s(frame, now)
            if late_s <= LATE_S:
                self._in_time_at = now
            may_be_late_s = MAX_LATE_S if now - self._in_time_at < CATCH_UP_S else 0.0
            if upcoming is not None and late_s > may_be_late_s and self.late_s(upcoming, now) >= 0:
                dropped.append((frame.index, frame.timestamp_s))
            else:
                if late_s < 0:
                    self._sleep(-late_s)
                self.n_late += late_s > LATE_S
                yield frame
            if broken is not None:
                raise broken
            frame = upcoming


def prepared(
    frames: Iterator[Frame], prepare: Callable[[Frame], Frame] | None, schedule: Schedule, clock: Callable[[], float]
) -> Iterator[tuple[Frame, float]]:
    """Yield frames, and how long each was prepared: the next one is begun when the last was taken.

    One that comes in time finds nothing else to be done: it goes as it is, and leaves the other cores alone.
    """
    if prepare is None:
        return ((frame, 0.0) for frame in frames)

    def ready() -> Iterator[tuple[Frame, float]]:
        for frame in frames:
            began = clock()
            late = schedule.late_s(frame, began) > LATE_S
            yield prepare(frame) if late else frame, clock() - began

    return read_ahead(ready(), depth=1)
