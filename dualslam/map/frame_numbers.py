"""The frames' own count, by which all of the system goes: it ascends as they come.

Here alone it is known that a source is read from its end, or that a saved map's frames have numbers already. Rows and
files tell a frame by its index in the source.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeVar

from dualslam.core.decisions import Decision
from dualslam.core.errors import InputError
from dualslam.core.events import Event
from dualslam.core.types import Frame

FRAMES_IN_EVENTS = (
    "agreeing_keyframes",
    "change_point",
    "first_view",
    "keyframe",
    "left",
    "lost_since",
    "onset",
    "other_frame",
    "other_keyframe",
    "suspected_since",
    "torn",
)
"""Fields of events, or of a part of one, that hold frames: one or a list. A number below 0 is a mark."""


Told = TypeVar("Told", Event, Decision)


class FrameNumbers:
    """Numbers of the frames of one source.

    A number is as far from the first frame's as their indices are: frames that were left out leave a gap. Read from its
    beginning, a source's frames have their index, on top of `first_id`.

    - `first_id`: 0, or where a saved map's count has ended.
    - `first_index`: the index of the first frame, if it is known.
    """

    def __init__(self, first_id: int = 0, first_index: int | None = None) -> None:
        self.first_id = first_id
        self.first_index = first_index
        self._index_of: dict[int, int] = {}
        self._last: int | None = None
        self._ended = False

    def end(self) -> None:
        """Take no more frames."""
        self._ended = True

    def numbered(self, frame: Frame) -> Frame:
        """Return the next frame with its number instead of its index.

        Raises `InputError` if it cannot be the next one.
        """
        if not isinstance(frame, Frame):
            raise InputError(f"step takes a dualslam.Frame(index, timestamp_s, image), not a {type(frame).__name__}.")
        if self._ended:
            raise InputError(f"frame {frame.index} comes after finish(), which ends a run: build another system.")
        number = self.number_of(int(frame.index))
        if self._last is not None and number <= self._last:
            raise InputError(
                f"frame {frame.index} comes after frame {self.index_of(self._last)}: the index of each frame must lie "
                "beyond the last one's, in one direction, because it identifies the frame."
            )
        self._last = number
        return replace(frame, index=self.number(int(frame.index)))

    def number(self, index: int) -> int:
        """Return the number of a frame, by its index; the first that is asked for is the first frame."""
        if self.first_index is None:
            self.first_index = index
        number = self.number_of(index)
        self._index_of[number] = index
        return number

    def number_of(self, index: int) -> int:
        """Return the number that a frame has or would have, once there is a first one."""
        first = index if self.first_index is None else self.first_index
        return self.first_id + first + abs(index - first)

    def index_of(self, number: int) -> int:
        """Return the index in the source of a frame; for one of a saved map what its number says, below 0."""
        return self._index_of.get(number, number - self.first_id)

    def told(self, record: Told) -> Told:
        """Return an event or a decision with all its frames by their index."""
        return replace(record, frame=self.index_of(record.frame), data=self.in_source(record.data))

    def in_source(self, data: Mapping[str, Any]) -> dict[str, Any]:
        """Return an event's data with its frames by their index."""

        def told(value: Any) -> Any:
            if isinstance(value, list | tuple):
                return [told(each) for each in value]
            return value if value is None or value < 0 else type(value)(self.index_of(int(value)))

        def within(value: Any) -> Any:
            if isinstance(value, list | tuple):
                return [within(each) for each in value]
            return self.in_source(value) if isinstance(value, Mapping) else value

        return {name: told(value) if name in FRAMES_IN_EVENTS else within(value) for name, value in data.items()}
