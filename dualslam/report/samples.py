"""Sample frames: small pictures around each gap in the tracking and of revisited places, chosen as the run goes on."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.types import Frame, FrameStatus

MAX_GAPS = 12
"""Gaps of which frames are kept: what a person looks at, and a bound on the size of the report."""
MIN_GAP_FRAMES = 3
"""Shorter gaps are a blink that tracking came back from."""
MAX_PLACES = 12
"""Revisited places of which pictures are kept, and that have a card: a bound on the size of the report."""
ALBUM_EVERY_S, ALBUM_SIZE = 0.5, 600
"""Time between two pictures that are remembered, and how many are: 5 to 10 MB."""
WIDTH_PX, THUMB_PX = 320, 160
JPEG_QUALITY = 72
POSED = frozenset({FrameStatus.TRACKED, FrameStatus.RECOVERED, FrameStatus.BYPASSED})


class SampleKeeper:
    """Watches a run, and keeps a JPEG of each gap's last frame before, first and last one, and the first after it."""

    def __init__(self, keep: Callable[[int, bytes], None]) -> None:
        self._keep = keep
        self._n_gaps = 0
        self._before: Frame | None = None
        self._gap: list[Frame] | None = None
        """First and latest frame of the gap that is open."""
        self._gap_frames = 0

    def take(self, frame: Frame, status: FrameStatus) -> None:
        """Look at one frame and its result."""
        if status not in POSED:
            self._gap = [frame] if self._gap is None else [self._gap[0], frame]
            self._gap_frames += 1
            return
        if self._gap is not None:
            self._close(frame)
        self._before = frame

    def finish(self) -> None:
        """End the run: a gap that is open now lasted to its end."""
        if self._gap is not None:
            self._close(None)

    def _close(self, after: Frame | None) -> None:
        assert self._gap is not None
        frames = [self._before, *self._gap, after]
        long_enough = self._gap_frames >= MIN_GAP_FRAMES or after is None
        if long_enough and self._n_gaps < MAX_GAPS:
            self._n_gaps += 1
            for frame in frames:
                if frame is not None and frame.image is not None:
                    self._keep(frame.index, thumbnail(frame.image))
        self._gap, self._gap_frames = None, 0


class PlaceAlbum:
    """Remembers what the camera has seen, and keeps JPEGs of a revisited place, then and now."""

    def __init__(self, keep: Callable[[int, bytes], None]) -> None:
        self._keep = keep
        self._pictures: dict[int, bytes] = {}
        self._last_s, self._every_s = -np.inf, ALBUM_EVERY_S
        self._n_shown = 0

    def take(self, frame: Frame, status: FrameStatus) -> None:
        """Remember a frame with a pose, twice a second; fewer where there are very many."""
        # Absolute: in a source that is read from its end times descend.
        if status not in POSED or frame.image is None or abs(frame.timestamp_s - self._last_s) < self._every_s:
            return
        self._last_s = frame.timestamp_s
        self._pictures[frame.index] = thumbnail(frame.image)
        if len(self._pictures) > ALBUM_SIZE:
            self._pictures = dict(list(self._pictures.items())[::2])
            self._every_s *= 2

    def evenly(self, n: int) -> dict[int, bytes]:
        """Return some of the pictures, smaller: at most `n`, evenly chosen."""
        chosen = list(self._pictures.items())[:: max(1, -(-len(self._pictures) // n))]
        return {index: smaller(jpeg) for index, jpeg in chosen}

    def show(self, indices: Sequence[int]) -> None:
        """Keep for good the pictures nearest to some frames, of one place; of earlier runs' frames there are none."""
        if self._n_shown == MAX_PLACES or not self._pictures:
            return
        self._n_shown += 1
        for index in (i for i in indices if i >= 0):
            nearest = min(self._pictures, key=lambda i: (abs(i - index), i))
            self._keep(nearest, self._pictures[nearest])


def smaller(jpeg: bytes) -> bytes:
    """Return a picture in the size of a thumb."""
    return thumbnail(
        cv2.cvtColor(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB), THUMB_PX
    )


def shrunk(image: NDArray[np.uint8], width_px: int) -> tuple[NDArray[np.uint8], float]:
    """Return an image of at most a width, in its own shape, and the factor by which it was resized."""
    height, width = image.shape[:2]
    factor = min(1.0, width_px / width)
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8), factor


def thumbnail(image: NDArray[np.uint8], width_px: int = WIDTH_PX) -> bytes:
    """Return a small JPEG of an image (H, W) or (H, W, 3) RGB."""
    small, _ = shrunk(image, width_px)
    if small.ndim == 3:
        small = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return bytes(data)
