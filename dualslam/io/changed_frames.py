"""The frames of a sequence, each changed on its way. What else a sequence has is that of the one behind it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, nullcontext
from typing import Any

from dualslam.core.camera.base import Camera
from dualslam.core.interfaces import Sequence
from dualslam.core.types import BoolArray, Frame


class ChangedFrames:
    """Frames of another sequence, changed where they have an image.

    - `change`: returns a frame as it is to be.
    - `camera`: of the changed images, if it is another one.
    - `hidden` (H, W) bool or None: the mask of all frames, if there is one.
    """

    def __init__(
        self,
        sequence: Sequence,
        change: Callable[[Frame], Frame],
        camera: Camera | None = None,
        hidden: BoolArray | None = None,
    ) -> None:
        self._sequence, self._change = sequence, change
        self.name, self.rate_hz = sequence.name, sequence.rate_hz
        self.camera = camera or sequence.camera
        if hidden is not None:
            self.hidden = hidden

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._sequence, name)

    def __len__(self) -> int:
        return len(self._sequence)

    def __iter__(self) -> Iterator[Frame]:
        frames: Any = iter(self._sequence)
        with closing(frames) if hasattr(frames, "close") else nullcontext():
            for frame in frames:
                yield frame if frame.image is None else self._change(frame)
