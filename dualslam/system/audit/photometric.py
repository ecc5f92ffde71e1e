"""Photometric audit of a run: stretches in which the images disagree with the map."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from dualslam.core.grey_image import GreyImage
from dualslam.core.interfaces import PatchCheck
from dualslam.core.types import Track, View
from dualslam.map.submap import Submap

INTERVAL_S = 0.18
"""Between two samples: five a second at all usual rates of frames."""
MIN_AGREEMENT = 0.25
"""Share of patches below which a sample disagrees. Maps that follow an occluder, or have lost their way in a turn, have
0 to 0.26. In seven right runs 2 of 730 samples are below, for blur or a corner that hides what was seen."""
MIN_SAMPLES = 3
"""Disagreeing samples in a row that make a stretch, 0.4 s or more. In right runs no two followed each other."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One frame compared with patches of an older keyframe."""

    index: int  # the frame's number inside the system
    timestamp_s: float
    submap_id: int
    agreement: float  # share of the patches that look as the map predicts, 0 to 1


@dataclass(frozen=True, slots=True)
class Stretch:
    """Consecutive samples that disagree: number of the first and last frame, and the median agreement."""

    first: int
    last: int
    agreement: float


class PhotometricAudit:
    """Compares tracked frames, but for those `repeated`, with the patches of older keyframes, a few times a second."""

    def __init__(self, patches: PatchCheck) -> None:
        self._patches = patches
        self.samples: list[Sample] = []
        self.repeated: set[int] = set()
        self._last_image: GreyImage | None = None
        self._last_s = float("-inf")

    def begin(self, submap: Submap, views: Iterable[View]) -> None:
        """Keep patches of the views that a submap starts from."""
        for view in views:
            self._patches.remember(submap, view)

    def take(self, submap: Submap, track: Track) -> None:
        """Compare a posed frame if a sample is due, and keep its patches if it has become a keyframe."""
        view = track.view
        if view.image is not None and self._last_image is not None and view.image.data == self._last_image.data:
            self.repeated.add(view.index)
        self._last_image = view.image
        if abs(view.timestamp_s - self._last_s) >= INTERVAL_S:
            agreement = self._patches.measure(submap, view, track.T_cam_submap)
            if agreement is not None:
                self._last_s = view.timestamp_s
                self.samples.append(Sample(view.index, view.timestamp_s, submap.id, agreement))
        if view.index in submap.keyframes:
            self._patches.remember(submap, view)

    def doubts(self, submap_id: int) -> bool:
        """Whether the newest sample disagrees with a map."""
        newest = self.samples[-1:]
        return bool(newest) and newest[0].submap_id == submap_id and newest[0].agreement < MIN_AGREEMENT

    def broken_since(self, submap_id: int) -> int | None:
        """Return the frame since which the images disagree with a map, after the last sample that agreed, if any."""
        newest = self.samples[-MIN_SAMPLES:]
        if not find_disagreement(newest).stretches or newest[0].submap_id != submap_id:
            return None
        before = self.samples[-MIN_SAMPLES - 1 : -MIN_SAMPLES]
        agreed = before and before[0].submap_id == newest[0].submap_id
        return before[0].index + 1 if agreed else newest[0].index


@dataclass(frozen=True, slots=True)
class Disagreement:
    """Where the samples of a run disagree with the map."""

    stretches: tuple[Stretch, ...]  # by ascending time
    worst: float
    """Largest share of patches that disagree in all of `MIN_SAMPLES` consecutive samples of one map. Above ``1 -
    MIN_AGREEMENT`` there is a stretch."""


def find_disagreement(samples: Iterable[Sample]) -> Disagreement:
    """Return the stretches of one map in which consecutive samples disagree, and the worst disagreement."""
    stretches, worst = [], 0.0
    for _, of_map in groupby(samples, key=lambda s: s.submap_id):
        part = list(of_map)
        agreement = np.array([sample.agreement for sample in part])
        if len(part) < MIN_SAMPLES:
            continue
        best = np.lib.stride_tricks.sliding_window_view(agreement, MIN_SAMPLES).max(axis=1)
        worst = max(worst, 1.0 - float(best.min()))
        begins = np.flatnonzero(best < MIN_AGREEMENT)
        for run in np.split(begins, np.flatnonzero(np.diff(begins) > 1) + 1) if len(begins) else []:
            first, last = int(run[0]), int(run[-1]) + MIN_SAMPLES - 1
            median = float(np.median(agreement[first : last + 1]))
            stretches.append(Stretch(part[first].index, part[last].index, median))
    return Disagreement(tuple(stretches), worst)
