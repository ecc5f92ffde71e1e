"""Landmarks that keyframes of one submap share, though each has mapped them for itself."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from dualslam.core.types import IntArray
from dualslam.map.submap import NO_LANDMARK, Submap


def share_landmarks(submap: Submap, matches: Collection[tuple[int, int, IntArray]]) -> int:
    """Let matched features of keyframes see one landmark, where one of the two has any, in place.

    A landmark is seen once in a keyframe: what would give it two features there is passed over.

    `matches`: two keyframes each, and (N, 2) their features that show the same.

    Returns int: how many pairs of features have come to see one landmark.
    """
    obs = submap.observations
    rows = np.flatnonzero(obs["alive"])
    seen_in: dict[int, set[int]] = {}
    for landmark, k in zip(obs["landmark"][rows].tolist(), obs["kf"][rows].tolist(), strict=True):
        seen_in.setdefault(landmark, set()).add(k)
    landmark_of = {k: ids.tolist() for k, ids in submap.landmark_of.items()}
    heir: dict[int, int] = {}
    added: dict[tuple[int, int], int] = {}

    def now(landmark: int) -> int:
        while landmark in heir:
            landmark = heir[landmark]
        return landmark

    for k_a, k_b, pairs in matches:
        for f_a, f_b in pairs.tolist():
            a, b = now(landmark_of[k_a][f_a]), now(landmark_of[k_b][f_b])
            if a == b:
                continue
            if NO_LANDMARK in (a, b):
                k, feature, landmark = (k_a, f_a, b) if a == NO_LANDMARK else (k_b, f_b, a)
                if k not in seen_in[landmark]:
                    seen_in[landmark].add(k)
                    landmark_of[k][feature] = added[k, feature] = landmark
            elif seen_in[a].isdisjoint(seen_in[b]):
                keep, drop = (a, b) if len(seen_in[a]) >= len(seen_in[b]) else (b, a)
                seen_in[keep] |= seen_in.pop(drop)
                heir[drop] = keep
    submap.merge_landmarks(np.array([now(j) for j in heir], np.int64), np.array(list(heir), np.int64))
    kf, feature = np.array(list(added), np.int64).reshape(-1, 2).T
    submap.add_observations(kf, feature, np.array([now(j) for j in added.values()], np.int64))
    return len(heir) + len(added)
