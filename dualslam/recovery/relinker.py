"""Links of reverse tracking: when to try its submap against the lost maps, what confirms a link, and when to stop."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from dualslam.core.geometry import sim3
from dualslam.core.noise_model import GROUP
from dualslam.core.types import Failure
from dualslam.linking import LinkEstimate, LinkRefusal, add_camera, propagate_to_live_end
from dualslam.linking.rivals import choose_by_velocity
from dualslam.map.submap import Submap
from dualslam.recovery.job import FoundLink, RecoveryParts
from dualslam.recovery.walk import Walk

ENOUGH = 10
"""Times the keyframes that a link needs. With so many healthy ones of a lost map a walk makes its last try: one that
fits none of them is bent, and going on bends it further."""

Linker = Callable[[Submap, Submap, int | None], LinkEstimate | Failure]

EACH_KEYFRAME = 12
"""Shared keyframes up to which each new one is a reason to try."""
GROWTH = 1.1
"""Beyond, a try comes when they have become so many times more: it costs as much as there are of them."""


@dataclass(frozen=True, slots=True, eq=False)
class LinkTry:
    """One try to link the growing submap with an older one."""

    old_id: int
    n_shared: int
    result: LinkEstimate | Failure


class Relinker:
    """Tries, at new keyframes of a walk, to link the growing submap with those that it has come to overlap.

    - `submap`: the growing one.
    - `onsets`: for each lost submap the frame from which on it is suspected to be corrupted.
    - `min_shared`: keyframes that both maps must hold before a link is tried.

    - `has_seen_enough`: whether the next keyframes change nothing: the walk has met enough of a lost submap's healthy
      part, or of what could hold its own torn map together.
    """

    def __init__(
        self,
        submap: Submap,
        lost: dict[int, Submap],
        onsets: dict[int, int],
        linker: Linker,
        min_shared: int,
    ) -> None:
        self._submap = submap
        self._linker = linker
        self._min_shared = min_shared
        self._onsets = onsets
        self._old = [lost[m] for m in sorted(lost)]
        self._tried_with: dict[int, int] = {}  # by old map: how many keyframes were shared at the last try
        self.has_seen_enough = False

    @property
    def keyframe_ids(self) -> set[int]:
        """Keyframes of the lost submaps."""
        return {k for old in self._old for k in old.keyframes}

    @property
    def holds_all(self) -> bool:
        """Whether the growing submap holds all keyframes of the lost submaps."""
        return self.keyframe_ids <= self._submap.keyframes.keys()

    @property
    def is_hopeless(self) -> bool:
        """Whether the growing submap holds all keyframes of the lost submaps, and these are too few for any link."""
        return self.holds_all and all(len(old.keyframes) < self._min_shared for old in self._old)

    def attempts(self, keyframe_id: int) -> Iterator[LinkTry]:
        """Try each lost submap that holds the newest keyframe of the walk, the latest lost one first."""
        for old in reversed(self._old):
            shared = old.keyframes.keys() & self._submap.keyframes.keys()
            if keyframe_id not in shared or not self._is_due(old.id, len(shared)):
                continue
            n_healthy = sum(k < self._onsets[old.id] for k in shared)
            self.has_seen_enough |= n_healthy >= ENOUGH * self._min_shared
            result = self._linker(old, self._submap, self._onsets[old.id])
            self.has_seen_enough |= isinstance(result, LinkRefusal) and self._stays_torn(result)
            yield LinkTry(old.id, len(shared), result)

    def _stays_torn(self, refused: LinkRefusal) -> bool:
        """Whether the growing submap is torn where all keyframes are there that are asked about the place."""
        torn_at = refused.torn_at
        return torn_at is not None and sum(k < torn_at for k in self._submap.keyframes) >= GROUP

    def _is_due(self, old_id: int, n_shared: int) -> bool:
        if n_shared < self._min_shared:
            return False
        if n_shared == self._tried_with.get(old_id):  # over keyframes that an earlier walk has left
            return False
        if n_shared > EACH_KEYFRAME and n_shared < GROWTH * self._tried_with.get(old_id, 0):
            return False
        self._tried_with[old_id] = n_shared
        return True


def confirm_link(
    walk: Walk, parts: RecoveryParts, old_id: int, result: LinkEstimate | Failure, with_doubt: bool = False
) -> FoundLink | Failure:
    """Return a link that holds as far as the live end, under the camera that the pixels ask for.

    `with_doubt`: its scale may be too loose to be relied on.
    """
    doubts: list[Failure] = []
    link = _propagate(walk, parts, result, doubts if with_doubt else None)
    if not isinstance(link, Failure) and not doubts:
        again = walk.tries.judge(old_id, link.sigma_scale, parts.max_scale_sigma)
        doubts = [] if again is None else [again]
        link = link if again is None or with_doubt else again
    if not isinstance(link, Failure) and (rivalled := _refuse_rivalled(walk, old_id, link)) is not None:
        link = rivalled
    why_not = doubts[0] if doubts else link
    if isinstance(why_not, Failure):
        walk.tries.note_try(old_id, why_not.reason)
    if isinstance(link, Failure):
        return link
    told = {"tries": walk.tries.refused[old_id] + 1.0, "rivals": float(len(walk.rivals))}
    return FoundLink(old_id, replace(link, numbers=link.numbers | told), walk.attempt, is_sure=not doubts)


def _propagate(
    walk: Walk, parts: RecoveryParts, result: LinkEstimate | Failure, doubts: list[Failure] | None
) -> LinkEstimate | Failure:
    """Carry a link to the live end, with what its camera bends; `doubts` takes what is to be said against it."""

    def held(refused: LinkEstimate | Failure) -> LinkEstimate | Failure:
        if doubts is None or not isinstance(refused, LinkRefusal) or refused.unsure is None:
            return refused
        doubts.append(refused)
        return refused.unsure

    submap, newest, config = walk.submap, walk.job.newest_id, parts.config.linking
    if isinstance(found := held(result), Failure):
        return found
    if isinstance(link := held(propagate_to_live_end(found, submap, newest, config)), Failure):
        return link
    return held(add_camera(link, submap, newest, partial(parts.find_camera, walk.job), config))


def _refuse_rivalled(walk: Walk, old_id: int, link: LinkEstimate) -> Failure | None:
    """Return why a link over a gap is not to be believed beyond which several poses are alike."""
    if not walk.rivals:
        return None
    sound = np.inf if link.suspected_onset is None else link.suspected_onset
    known = walk.job.paths[old_id].moved(sim3.inverse(link.S_old_new))
    walk.choice = choose_by_velocity(walk.path, known.take(known.index < sound), walk.rivals)
    return walk.choice.refusal
