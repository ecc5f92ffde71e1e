"""When the frames of a run in real time are due, and which of them are dropped."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from dualslam.core.schedule import Recorded
from dualslam.core.types import Frame
from dualslam.io.read_ahead import read_ahead

MAX_LATE_S = 1 / 15
"""So late a frame may be while the next one waits: two frames of a camera at 30 Hz. A keyframe mostly takes that much
more than other frames, and is caught up on after it. At 10 Hz a frame that the next one has overtaken is later."""
CATCH_UP_S = 1.0
"""Time without a punctual frame after which a system does not catch up: late frames are then dropped."""
LATE_S = 2e-3
"""A sleeping process may wake up so late. It does not count as lateness of the system."""


@dataclass(frozen=True, slots=True)
class Handed:
    """A frame to be looked at, how long it was prepared, and the frames before it that came too late."""

    frame: Frame
    dropped: tuple[Frame, ...] = ()
    prepared_s: float = 0.0


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

    def hand_out(self, frames: Iterator[Frame]) -> Iterator[Handed]:
        """Yield each frame when its time has come, with those before it that came too late.

        The next frame is asked for only where the one in hand may be dropped for it: a camera gives it when it is due,
        and no sooner. A frame that had to be waited for is the newest, and who waits is in time.
        """
        frame = next(frames, None)
        if frame is None:
            return
        self._first_s, self._began = frame.timestamp_s, self._clock()
        self._in_time_at = self._began
        dropped: list[Frame] = []
        while frame is not None:
            now = self._clock()
            late_s, upcoming, broken = self.late_s(frame, now), None, None
            if late_s <= LATE_S:
                self._in_time_at = now
            is_late = late_s > (MAX_LATE_S if now - self._in_time_at < CATCH_UP_S else 0.0)
            if is_late:
                try:
                    upcoming = self._fetched(frames)
                except Exception as error:  # after the frame in hand
                    broken = error
            if upcoming is not None and self.late_s(upcoming, self._clock()) >= 0:
                dropped.append(frame)
            else:
                if late_s < 0:
                    self._sleep(-late_s)
                self.n_late += late_s > LATE_S
                yield Handed(frame, tuple(dropped))
                dropped.clear()
            if broken is not None:
                raise broken
            frame = upcoming if is_late else self._fetched(frames)

    def _fetched(self, frames: Iterator[Frame]) -> Frame | None:
        """Return the next frame; None at the end."""
        asked = self._clock()
        frame, came = next(frames, None), self._clock()
        if came - asked > LATE_S:
            self._in_time_at = came
        return frame


def as_recorded(frames: Iterator[Frame], recorded: Recorded) -> Iterator[Handed]:
    """Yield the frames that a recorded run has looked at, with those before them that it dropped."""
    dropped: list[Frame] = []
    for frame in frames:
        if frame.index in recorded.dropped:
            dropped.append(frame)
        else:
            yield Handed(frame, tuple(dropped))
            dropped.clear()
        if frame.index == recorded.last_frame:
            return


def prepared(
    handed: Iterator[Handed], prepare: Callable[[Frame], Frame] | None, schedule: Schedule, clock: Callable[[], float]
) -> Iterator[Handed]:
    """Prepare the frames that are late: the next one is begun when the last was taken."""
    if prepare is None:
        return handed

    def ready() -> Iterator[Handed]:
        for each in handed:
            began = clock()
            late = schedule.late_s(each.frame, began) > LATE_S
            frame = prepare(each.frame) if late else each.frame
            yield replace(each, frame=frame, prepared_s=clock() - began)

    return read_ahead(ready(), depth=1)
