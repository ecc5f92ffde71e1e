"""How a submap has moved between two states of it, as a similarity: what was posed in the old one follows by it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.types import FloatArray
from dualslam.map.submap import Submap


def change_of_frame(
    before: Submap, after: Submap, keyframe_ids: Iterable[int], n_landmarks: int | None = None
) -> FloatArray:
    """Return ``S_after_before``, which takes the surroundings of some keyframes from one state of a map to the other.

    A solved map bends, so that no single similarity holds for all of it. This one holds about `keyframe_ids`: it turns
    and shifts as their poses did on average, and scales as the median depth of what they see. (Distances between
    cameras would not tell the scale of a turn in place.)

    - `before`, `after`: two states of one submap.
    - `keyframe_ids`: at least one of them stands in both.
    - `n_landmarks`: landmarks from this id on are not the same in both states.

    Returns (4, 4) float64.
    """
    shared = [k for k in keyframe_ids if k in before.keyframes and k in after.keyframes]
    if not shared:
        raise ValueError(f"submap {before.id}: none of the keyframes stands in both states")
    T_before, T_after = before.keyframe_poses(shared), after.keyframe_poses(shared)
    R = so3.orthonormalise((se3.rotation(T_after) @ se3.rotation(T_before).transpose(0, 2, 1)).sum(0))
    n = min(len(before.landmarks), len(after.landmarks), len(before.landmarks) if n_landmarks is None else n_landmarks)
    ratios = [_depth_ratios(before, after, k, n) for k in shared]
    together = np.concatenate(ratios)
    scale = float(np.median(together)) if len(together) else 1.0
    t = (se3.translation(T_after) - scale * se3.translation(T_before) @ R.T).mean(0)
    return sim3.from_parts(scale, R, t)


def _depth_ratios(before: Submap, after: Submap, k: int, n: int) -> FloatArray:
    """Depth after over depth before, of the landmarks that a keyframe sees."""
    ids = before.landmark_of[k]
    ids = ids[(ids >= 0) & (ids < n)]
    ids = ids[before.landmarks["alive"][ids] & after.landmarks["alive"][ids]]
    depths = [submap.depths(ids, se3.inverse(submap.T_submap_kf[k])) for submap in (before, after)]
    in_front = (depths[0] > 0) & (depths[1] > 0)
    return np.asarray(depths[1][in_front] / depths[0][in_front], np.float64)
