"""How far a run has come and what it is doing, in one line: on a terminal, in a notebook, in a log."""

from __future__ import annotations

import sys
import time
from shutil import get_terminal_size
from typing import TYPE_CHECKING, TextIO

from dualslam.core.types import Frame
from dualslam.core.walk_news import REGISTRATION, WalkNews
from dualslam.map.frame_records import FrameResult

if TYPE_CHECKING:
    from dualslam.system.system import System

FINISHING = "all frames are in: ending reverse tracking, registering frames, writing the results"
"""Said once no frame is left to count: the last reverse tracking may take seconds."""
IN_PLACE_S, LINE_S = 0.5, 15.0
"""Between two lines where the next takes the place of the one before, and where it stands below it."""


class RunState:
    """Current activity of a run, for a viewer.

    `n_frames`: how many frames there are, if that is known.
    """

    def __init__(self, n_frames: int | None) -> None:
        self.n_frames = n_frames
        self.n_done = 0
        self._system: System | None = None
        self._last: FrameResult | None = None
        self._walk: WalkNews | None = None
        self._began_s = time.monotonic()

    def time_left(self, now: float) -> str | None:
        """Return how long the rest takes at the rate so far, as m:ss; None where that is not known."""
        if not self.n_frames or not 0 < self.n_done < self.n_frames:
            return None
        return _duration((now - self._began_s) * (self.n_frames / self.n_done - 1.0))

    def begin(self, system: System) -> None:
        """Learn of the system."""
        self._system = system
        system.watch_walks(self._on_walk)

    def after(self, frame: Frame, result: FrameResult) -> None:
        """Count a frame."""
        self.n_done += 1
        self._last = result
        if self._walk is not None and self._system is not None:
            submap_id = self._walk.submap_id
            self._walk = self._walk if self._system.is_tracking_in_reverse(submap_id) else None
        self.changed()

    def is_paused(self) -> bool:
        """Pause nothing."""
        return False

    def end(self) -> None:
        """Note that the run is over."""
        self._walk = None
        self.changed()

    def _on_walk(self, news: WalkNews) -> None:
        self._walk = news
        self.changed()

    def changed(self) -> None:
        """Show what is new; nothing here."""

    @property
    def words(self) -> str:
        """Activity: posing frames, tracking in reverse, ending."""
        said = []
        if self.n_done == self.n_frames:
            said.append(FINISHING)
        elif self._last is not None:
            last = self._last
            where = "" if last.submap_id is None else f", submap {last.submap_id}, {last.n_inliers} landmarks"
            said.append(f"{last.status}{where}")
        if self._walk is not None:
            walk = self._walk
            what = "registering in" if walk.attempt == REGISTRATION else "tracking in reverse from"
            said.append(f"{what} submap {walk.submap_id}: at frame {walk.frame}, {walk.n_posed} posed")
        return "; ".join(said)


class Progress(RunState):
    """Writes it, now and then: ``run_to_folder(..., watcher=Progress(len(sequence)))``.

    - `n_frames`: how many frames there are; without it nothing is said of the time that is left.
    - `stream`: standard error if it is not given. On a terminal and in a notebook a line takes the place of the one
      before.
    """

    def __init__(self, n_frames: int | None = None, stream: TextIO | None = None) -> None:
        super().__init__(n_frames)
        self._stream = stream or sys.stderr
        self._in_place = self._stream.isatty() or type(self._stream).__module__.startswith("ipykernel")
        self._said_s = self._began_s
        self._width = 0

    def changed(self) -> None:
        """Write a line, if it is time."""
        now = time.monotonic()
        if now - self._said_s >= (IN_PLACE_S if self._in_place else LINE_S):
            self._said_s = now
            self._write(self._line(now))

    def end(self) -> None:
        """Write how far it came, and end the line."""
        super().end()
        if self._width:
            self._write(self._line(time.monotonic()))
            if self._in_place:
                self._stream.write("\n")
                self._stream.flush()
            self._width = 0

    def _write(self, line: str) -> None:
        if self._in_place:
            line = line[: get_terminal_size().columns - 1]
        self._stream.write(f"\r{line:<{self._width}}" if self._in_place else f"{line}\n")
        self._stream.flush()
        self._width = len(line)

    def _line(self, now: float) -> str:
        counted = f"frame {self.n_done}"
        if self.n_frames:
            counted = f"{self.n_done} of {self.n_frames} frames"
            if (left := self.time_left(now)) is not None:
                counted += f", {left} left"
        return f"{counted}: {self.words}"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
