"""Splitting of linked maps at a lost scale: a link holds only the part with the scale of its place.

A map that has lost its scale and goes on may be joined to another by its later, healthy part: by sight, or by reverse
tracking. What lies beyond the loss hangs on the joined map by nothing, and yet it would be posed in it, ten times too
large. So each map that is linked is asked once more, at the end of the run, when all that it has seen is in it: from
its links on, as far as it hands its scale on. The rest is split off as a submap of its own, with the links that stand
there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from dualslam.atlas.atlas import Atlas, Link, joined
from dualslam.atlas.endings import part_off
from dualslam.atlas.record import FrameStamp, Record
from dualslam.core.config.settings import LinkingConfig
from dualslam.core.events import EventKind
from dualslam.core.noise_model import GROUP
from dualslam.core.types import BoolArray, IntArray
from dualslam.linking.scale_observability import N_AROUND, answer_scale
from dualslam.map.landmark_views import noise_excess
from dualslam.map.split import submap_of
from dualslam.map.submap import Submap
from dualslam.recovery.scale_watch import FIRM_TIES, SCALE_INFLATION, count_ties, lost_from, question_about

SPAN = 2
"""Groups of keyframes across which the scale is asked for: a blurred turn may take longer than one, and hand on a
little from each to the next."""


@dataclass(frozen=True, slots=True, eq=False)
class _Loss:
    """Where a map does not hand its scale on, seen from a place outward."""

    between: IntArray  # (N,): keyframes that may be of either scale
    beyond: IntArray  # (M,): those of another one
    sigma: float  # standard deviation of its logarithm


def part_what_lost_its_scale(record: Record, submap_id: int, config: LinkingConfig, now: FrameStamp) -> None:
    """Split off the part of a map beyond a loss of scale, seen from its links.

    A map without a link is left as it is: nothing says which of its parts is the right one. So is what other maps tie
    together: the scale of either part is known there.

    - `submap_id`: of a map that is archived.
    - `config`: says by how much a scale must be off to be wrong.
    - `now`: for the event log.
    """
    submap = record.atlas.submaps[submap_id]
    held = _where_links_stand(record.atlas, submap_id) - submap.condemned
    if not held:
        return
    for later in (True, False):
        scales = _Scales(submap)
        outward = scales.ids if later else scales.ids[::-1]
        loss = _outermost_loss(
            record.atlas, submap_id, scales, outward, np.isin(outward, list(held)), lost_from(config)
        )
        if loss is None:
            continue
        rest = sorted([*loss.between.tolist(), *loss.beyond.tolist()])
        if len(rest) > 1:  # a submap has two keyframes at least
            anchor = int(outward[len(outward) - len(rest) - 1])
            _part_off(record, submap, rest, anchor, loss.sigma, now)


def _outermost_loss(
    atlas: Atlas, submap_id: int, scales: _Scales, outward: IntArray, is_held: BoolArray, max_sigma: float
) -> _Loss | None:
    """Return the loss of scale farthest out, seen from the link before it, beyond which nothing is tied to the rest.

    `outward` (G,): keyframes; `is_held` (G,): whether a link stands there.
    """
    rows = np.flatnonzero(is_held)
    for first, following in zip(rows[::-1].tolist(), [len(outward), *rows[:0:-1].tolist()], strict=True):
        if following - first <= SPAN * GROUP and following < len(outward):
            continue  # the next link is too near for a loss in between
        for loss in scales.losses(outward[max(first - GROUP + 1, 0) :], max_sigma):
            if np.isin(loss.between, outward[is_held]).any():
                break  # it is seen from the next link
            if not _is_held(atlas, submap_id, loss.beyond):
                return loss
    return None


class _Scales:
    """Asks a submap how well it hands its scale on from place to place.

    Attributes
    ----------
    ids : (F,) int64
        Its keyframes that are not condemned, ascending.
    """

    def __init__(self, submap: Submap) -> None:
        self._submap = submap
        self._excess = noise_excess(submap)
        self.ids = np.array(sorted(submap.keyframes.keys() - submap.condemned), np.int64)

    def losses(self, outward: IntArray, max_sigma: float) -> Iterator[_Loss]:
        """Yield the places at which the scale is lost, one after the other.

        - `outward` (G,): keyframes from a group of those that have the right scale on.
        - `max_sigma`: of the logarithm of the scale, from which on it is lost.
        """
        groups = [outward[begin : begin + GROUP] for begin in range(0, len(outward), GROUP)]
        for n in range(1, len(groups)):
            known = max(n - 1 - SPAN, 0)
            if (sigma := self._sigma(groups, known, n, max_sigma)) > max_sigma:
                yield _Loss(outward[GROUP * (known + 1) : GROUP * n], outward[GROUP * n :], sigma)

    def _sigma(self, groups: list[IntArray], known: int, asked: int, max_sigma: float) -> float:
        """Return the standard deviation of the log of the scale of one group against that of another; 0 where firm."""
        before, after = sorted((np.sort(groups[known]), np.sort(groups[asked])), key=lambda group: int(group[0]))
        begin, end = np.searchsorted(self.ids, [before[-1] + 1, after[0]]).tolist()
        if count_ties(self._submap, self.ids, begin, end, n_views=2) >= FIRM_TIES:
            return 0.0
        through = np.concatenate(groups[known : asked + 1]).tolist()
        inflation = SCALE_INFLATION * max(self._excess[k] for k in through)
        # What keyframes farther off have seen makes it no worse, and costs the cube of their number.
        for n_around in (N_AROUND, None):
            question = question_about(self._submap, self.ids, before, after, n_around)
            sigma = inflation * answer_scale(question)[0]
            if sigma <= max_sigma:
                break
        return sigma


def _where_links_stand(atlas: Atlas, submap_id: int) -> set[int]:
    """Return the keyframes of a map at which links to others stand."""
    held: set[int] = set()
    own = atlas.submaps[submap_id].keyframes.keys()
    for link, at in _links_at(atlas, submap_id):
        held |= {at, *(own & set(link.keyframes))}
    return held


def _links_at(atlas: Atlas, submap_id: int) -> Iterator[tuple[Link, int]]:
    """Yield the believed links of a map to others, each with the keyframe at which it stands."""
    for link in atlas.believed:
        if link.a != link.b and submap_id in (link.a, link.b):
            yield link, link.attached(atlas)[link.b == submap_id]


def _is_held(atlas: Atlas, submap_id: int, beyond: IntArray) -> bool:
    """Whether a loop within the map, or other maps, tie what lies beyond a loss to the rest."""
    loops = (link.attached(atlas) for link in atlas.believed if link.a == link.b == submap_id)
    if any(np.isin(loop, beyond).sum() == 1 for loop in loops):
        return True
    others = [link for link in atlas.believed if submap_id not in (link.a, link.b)]
    set_of = {m: component[0] for component in joined(atlas.submaps, others) for m in component}
    reached: dict[bool, set[int]] = {True: set(), False: set()}
    for link, at in _links_at(atlas, submap_id):
        reached[at in beyond].add(set_of[link.b if link.a == submap_id else link.a])
    return bool(reached[True] & reached[False])


def _part_off(record: Record, submap: Submap, rest: list[int], anchor: int, sigma: float, now: FrameStamp) -> None:
    """Make the keyframes at one end of a map a submap of their own, with the frames and links that hang on them."""
    atlas = record.atlas
    part = submap_of(submap, len(atlas.submaps), rest)
    moved = [_moved_to(link, submap, part, link.attached(atlas)) for link in atlas.links]
    if moved != atlas.links:
        for m in atlas.component_of(submap.id):
            atlas.placement.pop(m, None)  # it is composed along its links again
    part_off(record, submap, part, anchor)
    atlas.links = moved
    frames = sorted(pose.index for pose in record.own_poses() if pose.submap_id == part.id)
    told = {"reason": "scale_lost", "sigma_scale": sigma, "old_submap": part.id, "left": frames}
    record.event(EventKind.CUT, now, submap.id, **told)


def _moved_to(link: Link, old: Submap, part: Submap, at: tuple[int, int]) -> Link:
    """Return a link, of the part where an end of it stands at a keyframe of that; both have the same coordinates."""
    if link.a == old.id and at[0] in part.keyframes:
        link = replace(link, a=part.id, keyframe_a=at[0])
    if link.b == old.id and at[1] in part.keyframes:
        link = replace(link, b=part.id, keyframe_b=at[1])
    return link
