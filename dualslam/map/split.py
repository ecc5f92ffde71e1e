"""Submaps out of submaps: a full one hands on to the next, and one that is broken falls into two."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from dualslam.core.geometry import se3
from dualslam.core.types import IntArray
from dualslam.map.submap import NO_LANDMARK, Submap


def next_submap(full: Submap, submap_id: int, n_shared: int, newest_id: int | None = None) -> Submap:
    """Start a submap from the newest keyframes of a full one, in the same coordinates.

    The newest keyframe may not see what earlier ones see, if the map was full when it was relocalised. Then those that
    do are taken.

    - `n_shared`: how many of the newest keyframes (in order of insertion) both submaps hold.
    - `newest_id`: the keyframe that was inserted last.

    Returns Submap: with the shared keyframes and those of their landmarks that at least two of them see. Its gauge is
    the pair of shared keyframes that stand farthest apart in the full submap. So the link between the two is the
    identity.
    """
    shared = list(full.keyframes)[-n_shared:]
    if newest_id is not None:
        covisible = full.covisible(full.seen_in(newest_id))[0].tolist()
        if np.isin(shared, covisible).sum() < min(len(shared), len(covisible)) / 2:
            wanted = {newest_id, *covisible[:n_shared]}
            shared = [k for k in full.keyframes if k in wanted]
    return submap_of(full, submap_id, shared)


def submap_of(submap: Submap, submap_id: int, keyframe_ids: list[int]) -> Submap:
    """Copy some keyframes of a submap, and of their landmarks those that at least two of them see, to a new one.

    In the same coordinates; its gauge is the pair of these keyframes that stand farthest apart.
    """
    twin = Submap(submap_id, submap.K, submap.landmarks["descriptor"][0])
    for k in keyframe_ids:
        twin.add_keyframe(submap.keyframes[k], submap.T_submap_kf[k])
    old = submap.landmarks_of_keyframes(keyframe_ids)
    old = old[submap.n_views_among(keyframe_ids)[old] >= 2]
    twin.copy_landmarks(submap, old)
    new_id = np.full(len(submap.landmarks), NO_LANDMARK, np.int64)
    new_id[old] = np.arange(len(old))
    for k in keyframe_ids:
        ids = submap.landmark_of[k]
        feature = np.flatnonzero(ids >= 0)
        kept = new_id[ids[feature]] >= 0
        twin.add_observations(k, feature[kept], new_id[ids[feature[kept]]])
    twin.gauge = _widest_pair(submap, keyframe_ids)
    return twin


def shared_landmarks(old: Submap, new: Submap) -> IntArray:
    """Return for each landmark of a submap the one that the same feature shows in another, or `NO_LANDMARK`.

    Of landmarks that have become one with others: what these are.
    """
    id_of = np.full(len(old.landmarks), NO_LANDMARK, np.int64)
    for k in old.keyframes.keys() & new.keyframes.keys():
        was, now = old.landmark_of[k], new.landmark_of[k]
        both = np.flatnonzero((was != NO_LANDMARK) & (now != NO_LANDMARK))
        id_of[was[both]] = now[both]
    return old.by_heirs(id_of)


def take_out(submap: Submap, keyframe_ids: Iterable[int], anchor: int) -> None:
    """Take keyframes out of a map: they are anchored to the keyframe `anchor`, and what they alone hold dies."""
    for k in keyframe_ids:
        submap.remove_keyframe(k, anchor)
    alive = np.flatnonzero(submap.landmarks["alive"])
    submap.remove_landmarks(alive[submap.n_observations(alive) < 2])
    submap.gauge = _widest_pair(submap, sorted(submap.keyframes))


def sound_copy(submap: Submap) -> Submap:
    """Return a copy without the keyframes that are marked invalid, as long as others are left."""
    twin = submap.copy()
    sound = twin.keyframes.keys() - twin.condemned
    if len(sound) >= 2 and twin.condemned:
        take_out(twin, sorted(twin.condemned), max(sound))
    return twin


def _widest_pair(submap: Submap, keyframe_ids: list[int]) -> tuple[int, int]:
    """Return the two keyframes that are farthest apart: a distance that is known the better the longer it is."""
    centres = se3.translation(submap.keyframe_poses(keyframe_ids))
    apart = np.linalg.norm(centres[:, None] - centres, axis=2)
    first, second = np.unravel_index(int(apart.argmax()), apart.shape)
    return keyframe_ids[int(first)], keyframe_ids[int(second)]
