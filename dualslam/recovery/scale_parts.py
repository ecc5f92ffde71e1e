"""Splitting of linked maps at a lost scale: a link holds only the part with the scale of its place.

A map that has lost its scale may be joined to another by its later, healthy part. What lies beyond the loss hangs on
the joined map by nothing, and yet it would be posed in it. So each map that is linked is asked at the end of the run
how far, from its links on, it hands its scale on. The rest is split off as a submap of its own, with the links that
stand there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from dualslam.atlas.atlas import Atlas, Link, joined
from dualslam.atlas.endings import part_off
from dualslam.atlas.record import FrameStamp, Record
from dualslam.core.config.settings import LinkingConfig
from dualslam.core.events import EventKind
from dualslam.core.noise_model import GROUP
from dualslam.core.types import BoolArray, IntArray
from dualslam.linking.scale_observability import scale_sigmas_in_all
from dualslam.map.landmark_views import noise_excess
from dualslam.map.split import submap_of
from dualslam.map.submap import Submap
from dualslam.recovery.scale_watch import FIRM_TIES, count_ties, lost_from


def part_what_lost_its_scale(record: Record, submap_id: int, config: LinkingConfig, now: FrameStamp) -> None:
    """Split off the part of a map beyond a loss of scale, seen from its links; without one it is left as it is.

    What other maps tie together stays: the scale of either part is known there.

    - `submap_id`: of a map that is archived.
    - `config`: says by how much a scale must be off to be wrong.
    """
    submap = record.atlas.submaps[submap_id]
    held = _where_links_stand(record.atlas, submap_id) - submap.condemned
    if not held:
        return
    for later in (True, False):
        ids = np.array(sorted(submap.keyframes.keys() - submap.condemned), np.int64)
        if all(count_ties(submap, ids, at, at, n_views=2) >= FIRM_TIES for at in range(GROUP, len(ids), GROUP)):
            return
        outward = ids if later else ids[::-1]
        rest, sigma = _outermost_loss(record.atlas, submap, outward, np.isin(outward, list(held)), lost_from(config))
        if len(rest) > 1:  # a submap has two keyframes at least
            anchor = int(outward[len(outward) - len(rest) - 1])
            _part_off(record, submap, sorted(rest.tolist()), anchor, sigma, now)


def _outermost_loss(
    atlas: Atlas, submap: Submap, outward: IntArray, is_held: BoolArray, max_sigma: float
) -> tuple[IntArray, float]:
    """Return the keyframes behind the loss of scale farthest out, seen from a link, that nothing else ties to the rest.

    - `outward` (F,): keyframes; `is_held` (F,): whether a link stands there.
    - `max_sigma`: of the logarithm of the scale, from which on it is lost.

    Returns (IntArray, float): empty where there is none; and how well the scale is known where it is first lost.
    """
    links = np.flatnonzero(is_held & ~np.append(is_held[1:], False))[::-1].tolist()
    places = [
        (outward[begin : begin + GROUP], outward[max(link - GROUP + 1, 0) : link + 1])
        for link in links
        for begin in range(link + 1, len(outward), GROUP)
    ]
    if not places:
        return outward[:0], 0.0
    sigmas = iter(scale_sigmas_in_all(submap, places, noise_excess(submap)))
    for link in links:
        begins = np.arange(link + 1, len(outward), GROUP)
        sigma = np.array([next(sigmas) for _ in begins])
        n_lost = int(np.minimum.accumulate(sigma[::-1] > max_sigma).sum())
        # The first group may have keyframes of either scale: what ties it may tie the others of it.
        if n_lost and not _is_held(atlas, submap.id, outward[begins[-max(n_lost - 1, 1)] :]):
            return outward[begins[-n_lost] :], float(sigma[-n_lost])
    return outward[:0], 0.0


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
