"""The gauge of a submap's graph: which pose is fixed and which baseline carries the scale."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeGuard

import numpy as np

from dualslam.core.geometry import se3
from dualslam.core.types import FloatArray
from dualslam.map.submap import Submap

MIN_BASELINE_MU = 1e-3
"""Shorter than this a baseline cannot carry the scale (the median initial depth is 1)."""
MOVED_TOLERANCE = 1e-2
N_NEIGHBOURS = 10


@dataclass(frozen=True, slots=True, eq=False)
class Gauge:
    """The pose and the distance that are held."""

    first: int
    T_submap_first: FloatArray  # (4, 4)
    second: int | None  # none where there is no other keyframe at a distance
    baseline_mu: float

    def was_moved_in(self, submap: Submap) -> bool:
        """Return whether the submap's arrays stand in another gauge than the graph (after `Submap.transform`)."""
        T = submap.T_submap_kf.get(self.first)
        if T is None:
            return False
        off = se3.inverse(self.T_submap_first) @ T
        if np.abs(off[:3, :3] - np.eye(3)).max() > MOVED_TOLERANCE:
            return True
        if np.linalg.norm(off[:3, 3]) > MOVED_TOLERANCE * max(1.0, self.baseline_mu):
            return True
        other = submap.T_submap_kf.get(self.second) if self.second is not None else None
        if other is None:
            return False
        length = float(np.linalg.norm(other[:3, 3] - T[:3, 3]))
        return abs(length - self.baseline_mu) > MOVED_TOLERANCE * self.baseline_mu


def choose_gauge(submap: Submap, current: Gauge | None, pose: Callable[[int], FloatArray]) -> Gauge:
    """Return the gauge to use: the submap's where its keyframes live, else the one in use, else a neighbour.

    A new gauge is taken at the poses as they are estimated now, so that nothing jumps.

    - `submap`: with at least one keyframe.
    - `current`: is returned itself where nothing has to change.
    - `pose`: gives the present ``T_submap_kf`` of a keyframe.
    """
    live = submap.keyframes.keys()
    mine = (current.first, current.second) if current is not None else (None, None)
    wanted_first, wanted_second = submap.gauge
    if wanted_first in live:
        first = wanted_first
    elif mine[0] in live:
        first = mine[0]
    else:
        first = _heir(submap, wanted_first)
    T_first = pose(first)

    def distance(k: int) -> float:
        return float(np.linalg.norm(pose(k)[:3, 3] - T_first[:3, 3]))

    def serves(k: int | None) -> TypeGuard[int]:
        return k is not None and k in live and k != first

    if current is not None and first == mine[0]:
        if serves(mine[1]) and (mine[1] == wanted_second or not serves(wanted_second)):
            return current
        if mine[1] is None and len(live) == 1:
            return current
    for second in (wanted_second, mine[1]):
        if serves(second) and distance(second) > MIN_BASELINE_MU:
            return Gauge(first, T_first, second, distance(second))
    # The farthest of the keyframes that share most with the first one.
    ids, _ = submap.covisible(submap.landmarks_of_keyframes([first]))
    near = [k for k in ids.tolist() if k != first and k in live][:N_NEIGHBOURS] or [k for k in live if k != first]
    second = max(near, key=distance, default=None)
    if second is None or distance(second) <= MIN_BASELINE_MU:
        return (
            current
            if current is not None and first == mine[0] and mine[1] is None
            else Gauge(first, T_first, None, 0.0)
        )
    return Gauge(first, T_first, second, distance(second))


def _heir(submap: Submap, culled: int) -> int:
    """Return the keyframe that a culled one is anchored to, or the earliest."""
    while culled in submap.anchors and culled not in submap.keyframes:
        culled = submap.anchors[culled].keyframe_id
    return culled if culled in submap.keyframes else min(submap.keyframes)
