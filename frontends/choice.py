"""Which front end a sequence asks for: corners, or blobs where its images show few corners."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, islice

import numpy as np

from dualslam.core.errors import InputError
from dualslam.core.estimates import FrontendChoice
from dualslam.core.interfaces import Frontend, MapStarter
from dualslam.core.types import Failure, Frame, View

LOOKED_AT, STEP = 9, 4
"""First frames, and every so many-th of them whose corners are counted: three images, so that one may be blurred."""
STARTS_WITHIN = 200
"""First frames in which either must start a map. On rendered white walls the start came at frame 25 to 158."""
FEW = 0.5
"""Share of the corners asked for, below which an image shows few. Recordings of streets and furnished rooms have all of
them, white walls a quarter to a third."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A front end, with what starts a map by it, and what returns a frame's view with its features."""

    frontend: Frontend
    starter: MapStarter
    view_of: Callable[[Frame], View | Failure]

    @property
    def name(self) -> str:
        """The front end's."""
        return self.frontend.name

    def starts_at(self, frame: Frame) -> bool:
        """Whether a map starts with this frame; frames come in their order."""
        view = self.view_of(frame)
        return isinstance(view, View) and bool(self.starter.add(view))


def choose_frontend(frames: Iterable[Frame], corners: Candidate, blobs: Candidate, n_features: int) -> FrontendChoice:
    """Choose between corners and blobs by a sequence's first frames.

    Blobs cost several times the CPU. They are chosen where images show few corners and blobs are the first to start a
    map.

    Parameters
    ----------
    frames : iterable of Frame
        From the first one on; as many are read as the choice needs.
    corners, blobs : Candidate
    n_features : int
        Corners that are asked for.
    """
    coming = _until_an_error(frames)
    first = list(islice(coming, LOOKED_AT))
    images = [frame.image for frame in first[::STEP] if frame.image is not None]
    if not images:
        return FrontendChoice(corners.name, "the first images cannot be read")
    n = int(np.median([len(corners.frontend.extract(image)) for image in images]))
    found = f"{n} of {n_features} corners in an image"
    if n >= FEW * n_features:
        return FrontendChoice(corners.name, found)
    for frame in islice(chain(first, coming), STARTS_WITHIN):
        for each in (corners, blobs):
            if each.starts_at(frame):
                return FrontendChoice(each.name, f"{found}, and {each.name} starts a map first, at frame {frame.index}")
    return FrontendChoice(corners.name, f"{found}, and no map starts")


def _until_an_error(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Yield frames until one cannot be had: the run comes to the same error, and reports it."""
    try:
        yield from frames
    except InputError:
        return
