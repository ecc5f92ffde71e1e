"""Algorithm 1: walk back in time from a new submap until it overlaps a lost one so well that a Sim(3) links the two.

The walk is the visual front end, given the buffered frames latest first. It sees images and features only, never the
old map's poses or landmarks: a link must not confirm itself. What it takes from the old map is which frames were
keyframes, so that both maps hold the same ones.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from dualslam.atlas import Atlas
from dualslam.core.config import RecoveryConfig
from dualslam.core.errors import SolverError
from dualslam.core.interfaces import KeyframeReport, VisualOdometry
from dualslam.core.submap import Submap
from dualslam.core.types import Failure, Track, View
from dualslam.linking import LinkEstimate

log = logging.getLogger(__name__)

Judge = Callable[[Track | Failure], Track | Failure]
Linker = Callable[[Submap, Submap, int | None], LinkEstimate | Failure]


@dataclass(frozen=True, slots=True, eq=False)
class WalkStep:
    """One frame of a walk back: where it was found to be, and whether it became a keyframe."""

    view: View
    track: Track
    report: KeyframeReport | None


@dataclass(frozen=True, slots=True, eq=False)
class LinkAttempt:
    """One try to link the growing submap with an older one."""

    old_id: int
    n_shared: int
    result: LinkEstimate | Failure


def walk_back(
    walker: VisualOdometry, views: Iterable[View], judge: Judge, keyframe_ids: set[int], max_leap_frames: int
) -> Iterator[WalkStep]:
    """Pose frames one after the other in the order given, and extend the walker's submap by keyframes.

    Parameters
    ----------
    walker : VisualOdometry
        Started at a keyframe of its submap.
    views : iterable of View
        Latest first.
    judge : callable
        The health verdict on a track.
    keyframe_ids : set of int
        Frames that become keyframes in any case: those that were keyframes of an older submap.
    max_leap_frames : int
        So many frames in a row may be unusable before the walk ends.
    """
    n_failed = 0
    for view in views:
        track = judge(walker.track(view))
        if isinstance(track, Failure):
            n_failed += 1
            if n_failed > max_leap_frames:
                return
            continue
        n_failed = 0
        wanted = view.index in keyframe_ids and view.index not in walker.submap.keyframes
        report = None
        if wanted or walker.keyframe_due(track):
            try:
                report = walker.insert_keyframe(track)
            except SolverError as error:
                log.warning("the walk back ends at frame %d: %s", view.index, error)
                return
        yield WalkStep(view, track, report)


class Relinker:
    """Tries, at each new keyframe of a walk, to link the growing submap with those that it has come to overlap.

    Parameters
    ----------
    atlas : Atlas
    submap : Submap
        The growing one.
    onsets : dict of int to int
        For each lost submap the frame from which on it is suspected to be corrupted.
    """

    def __init__(
        self, atlas: Atlas, submap: Submap, onsets: dict[int, int], linker: Linker, config: RecoveryConfig
    ) -> None:
        self._submap = submap
        self._linker = linker
        self._config = config
        self._onsets = onsets
        self._old = [atlas.submaps[m] for m in sorted(onsets) if m != submap.id]

    @property
    def keyframe_ids(self) -> set[int]:
        """Keyframes of the lost submaps."""
        return {k for old in self._old for k in old.keyframes}

    def attempts(self, keyframe_id: int) -> Iterator[LinkAttempt]:
        """Try each lost submap that holds the newest keyframe of the walk, the latest lost one first."""
        for old in reversed(self._old):
            shared = old.keyframes.keys() & self._submap.keyframes.keys()
            if keyframe_id not in shared or len(shared) < self._config.min_shared_keyframes:
                continue
            yield LinkAttempt(old.id, len(shared), self._linker(old, self._submap, self._onsets[old.id]))
