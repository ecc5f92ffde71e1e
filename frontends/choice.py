"""Which front end a sequence asks for: corners, or blobs where corners are few or steps are wide."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, islice, pairwise

import numpy as np
from numpy.typing import NDArray

from dualslam.core.errors import InputError
from dualslam.core.estimates import FrontendChoice
from dualslam.core.interfaces import Frontend, MapStarter
from dualslam.core.noise_model import MIN_CONSENSUS
from dualslam.core.types import Failure, Frame, View

LOOKED_AT, STEP = 9, 4
"""First frames, and every so many-th of them whose corners are counted: three images, so that one may be blurred."""
STARTS_WITHIN = 200
"""First frames in which either must start a map. On rendered white walls the start came at frame 25 to 158."""
FEW = 0.5
"""Share of the corners asked for, below which an image shows few. Recordings of streets and furnished rooms have all of
them, white walls a quarter to a third."""

STEPS_WITHIN = 40
"""First frames whose steps are measured."""
MISPREDICTED = 1 / 32
"""Of the image's width: by how much a step is mispredicted that leads to other things than those that are mapped. In
pixels, every fifth frame of `kitti_03` is no better predicted than `phone_terrace`, and ORB is better there."""
OFTEN, SELDOM = 0.25, 0.25
"""Share of the steps that a constant velocity mispredicts so far; share of the corners that match in the next frame.
Steps are wide from the one on and below the other. In `phone_terrace` they are 0.42 to 0.79 and 0.11 to 0.19, in fast
turns of `hololens_000` 0.34 to 0.63 and 0.33 to 0.40. In all others at most 0.13 are mispredicted."""
MORE = 2
"""Times as many features for wide steps. With as many as asked for, a map of `phone_terrace` went through a turn to 2.4
times its scale. With twice as many, that was seen in two of two runs, and the map was split there."""


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

    Blobs cost several times the CPU. They are chosen where images show few corners and blobs start a map first. So they
    are where steps are so wide that few corners are found again.

    - `frames`: from the first one on; as many are read as the choice needs.
    - `n_features`: corners that are asked for.
    """
    coming = _until_an_error(frames)
    first = list(islice(coming, LOOKED_AT))
    images = [frame.image for frame in first[::STEP] if frame.image is not None]
    if not images:
        return FrontendChoice(corners.name, "the first images cannot be read")
    n = int(np.median([len(corners.frontend.extract(image)) for image in images]))
    found = f"{n} of {n_features} corners in an image"
    if n >= FEW * n_features:
        steps = chain(first, islice(coming, STEPS_WITHIN - LOOKED_AT))
        wide = _wide_steps([f.image for f in steps if f.image is not None], corners.frontend)
        if wide is not None:
            return FrontendChoice(blobs.name, wide, MORE * n_features)
        return FrontendChoice(corners.name, found)
    for frame in islice(chain(first, coming), STARTS_WITHIN):
        for each in (corners, blobs):
            if each.starts_at(frame):
                return FrontendChoice(each.name, f"{found}, and {each.name} starts a map first, at frame {frame.index}")
    return FrontendChoice(corners.name, f"{found}, and no map starts")


def _wide_steps(images: list[NDArray[np.uint8]], frontend: Frontend) -> str | None:
    """Return what shows that steps between frames are wide, by the median flow of matches; None where they are not."""
    flows, shares = [], []
    for before, after in pairwise(map(frontend.extract, images)):
        i, j = frontend.match_wide(before, after).index.T
        shares.append(len(i) / max(len(before), 1))
        if 2 * np.count_nonzero(np.array(shares) >= SELDOM) >= len(images):
            return None  # more than half of the steps, whatever follows
        moved = after.uv_px[j] - before.uv_px[i]
        flows.append(np.median(moved, axis=0) if len(i) >= MIN_CONSENSUS else np.full(2, np.nan))
    errors = np.linalg.norm(np.diff(np.reshape(flows, (-1, 2)), axis=0), axis=1) / images[0].shape[1]
    known = errors[np.isfinite(errors)]
    if not len(known):
        return None
    often, matched = float(np.mean(known > MISPREDICTED)), float(np.median(shares))
    if often < OFTEN or matched >= SELDOM:
        return None
    return f"{often:.0%} of the steps are mispredicted, and {matched:.0%} of the corners match between frames"


def _until_an_error(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Yield frames until one cannot be had: the run comes to the same error, and reports it."""
    try:
        yield from frames
    except InputError:
        return
