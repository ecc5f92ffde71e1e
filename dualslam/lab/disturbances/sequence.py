"""A sequence with corruptions put on it: the same interface as any other."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from dualslam.core.config.corruption import CAMERA_KINDS, CLOCK_KINDS, RENDERED_KINDS, Corruption, CorruptionKind
from dualslam.core.errors import ConfigError
from dualslam.core.interfaces import Sequence
from dualslam.core.types import Frame, IntArray
from dualslam.lab.disturbances.images import U8Image, corrupt_image
from dualslam.lab.disturbances.inputs import WrongClock, wrong_camera

log = logging.getLogger(__name__)

# In the order of the light's way: scene, what is before the lens, lens, shutter, sensor, recorder.
_ON_IMAGES = (
    CorruptionKind.WIPE,
    CorruptionKind.OCCLUSION,
    CorruptionKind.CAB,
    CorruptionKind.BONNET,
    CorruptionKind.BLUR,
    CorruptionKind.MOTION_BLUR,
    CorruptionKind.BLACKOUT,
    CorruptionKind.EXPOSURE,
    CorruptionKind.NOISE,
    CorruptionKind.BARS,
    CorruptionKind.LOGO,
    CorruptionKind.CLOCK,
)
_ON_STREAM = (CorruptionKind.FREEZE, CorruptionKind.DROP, CorruptionKind.STRIDE)


def corrupted(sequence: Sequence, corruptions: Collection[Corruption]) -> Sequence:
    """Return the sequence with corruptions put on it: itself, where all of them are faults inside the system.

    One that meets none of the frames gives a warning.

    Raises
    ------
    ConfigError
        Where one of them is for rendered worlds.
    """
    for corruption in corruptions:
        if corruption.kind in RENDERED_KINDS:
            raise ConfigError(f"{corruption.kind} is for rendered worlds: write it into their script (events=FILE)")
    _tell_idle(getattr(sequence, "source_indices", None), corruptions)
    inputs = CAMERA_KINDS | CLOCK_KINDS
    chosen = [c for c in corruptions if c.kind in _ON_IMAGES + _ON_STREAM or c.kind in inputs]
    return CorruptedSequence(sequence, chosen) if chosen else sequence


def _tell_idle(indices: IntArray | None, corruptions: Iterable[Corruption]) -> None:
    """Warn of corruptions that cover none of the frames; a live source does not know its own."""
    if indices is None or not len(indices):
        return
    for c in corruptions:
        if not any(map(c.covers, indices.tolist())):
            end = " on" if c.length is None else f" to {c.start + c.length - 1}"
            asked = f"{c.kind} at frames {c.start}{end}"
            log.warning("%s never strikes: the run's frames are %d to %d", asked, indices.min(), indices.max())


class CorruptedSequence:
    """Frames of another sequence, spoilt. What no corruption changes (ground truth, exposure) is that sequence's.

    Frames that are dropped do not arrive at all, and are in none of the lists; indices stay those of the source.

    Parameters
    ----------
    sequence : Sequence
        Recorded, rendered or live.
    corruptions : iterable of Corruption
        Several of a kind add up, one after the other; faults inside the system are not for here and do nothing.
    """

    def __init__(self, sequence: Sequence, corruptions: Iterable[Corruption]) -> None:
        self._sequence = sequence
        self._corruptions = tuple(corruptions)
        self.name = sequence.name
        self.camera = wrong_camera(sequence.camera, self._corruptions)
        self.rate_hz = sequence.rate_hz

    def __getattr__(self, name: str) -> Any:
        # Ground truth, exposure and whatever else a recording has beyond the protocol.
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._sequence, name)

    @property
    def source_indices(self) -> IntArray:
        """(M,) int64, index in the source of each frame that arrives, in reading order."""
        return np.asarray(self._indices()[self._arriving()], np.int64)

    @property
    def frame_timestamps(self) -> Any:
        """(M,) float64, the same frames' times, as the clock gives them."""
        true_s = getattr(self._sequence, "frame_timestamps")[self._arriving()]  # noqa: B009
        return self._clock().times_of(self.source_indices, true_s)

    def __len__(self) -> int:
        len(self._sequence)  # a webcam has no length, and says so
        return int(self._arriving().sum())

    def __iter__(self) -> Iterator[Frame]:
        source = iter(self._sequence)
        last: U8Image | None = None  # the newest image that was not frozen
        clock = self._clock()
        try:
            for arriving in source:
                if not self._arrives(arriving.index):
                    continue
                frame = replace(arriving, timestamp_s=clock.time_of(arriving.index, arriving.timestamp_s))
                frozen = last is not None and self._active(frame.index, CorruptionKind.FREEZE)
                image = last if frozen else frame.image
                if image is None:
                    yield frame
                    continue
                last = image
                yield replace(frame, image=self._spoil(image, frame.index), error="")
        finally:
            close = getattr(source, "close", None)
            if close is not None:
                close()

    def _clock(self) -> WrongClock:
        return WrongClock(self._corruptions, 1.0 / self.rate_hz)

    def _spoil(self, image: U8Image, index: int) -> U8Image:
        for kind in _ON_IMAGES:
            for corruption in self._active(index, kind):
                image = corrupt_image(image, corruption, index)
        return image

    def _active(self, index: int, kind: CorruptionKind) -> list[Corruption]:
        return [c for c in self._corruptions if c.kind is kind and c.covers(index)]

    def _arrives(self, index: int) -> bool:
        if self._active(index, CorruptionKind.DROP):
            return False
        strides = self._active(index, CorruptionKind.STRIDE)
        return all((index - c.start) % round(c.level) == 0 for c in strides)

    def _indices(self) -> IntArray:
        return np.asarray(getattr(self._sequence, "source_indices"))  # noqa: B009

    def _arriving(self) -> Any:
        return np.array([self._arrives(i) for i in self._indices().tolist()], bool)
