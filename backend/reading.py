"""Which part of a graph's estimate is read after an update and judged by what, and the landmarks beside the graph."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dualslam.backend.factor_index import FactorIndex
from dualslam.backend.observability import numbered, take_mask
from dualslam.core.geometry import se3
from dualslam.core.types import BoolArray, FloatArray, IntArray
from dualslam.map.submap import Submap

READ_WINDOW = 20
"""Keyframes (the last inserted ones, and their landmarks) whose estimate is read after each update."""
READ_ALL = 0


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A part of a submap's graph."""

    # Keyframe and landmark of each observation row that the graph has looked at.
    kf: IntArray  # (R,)
    lm: IntArray  # (R,)
    inside: IntArray  # (I,): rows that are admitted and alive
    row: IntArray  # (N,): those of them by which the part is judged
    # Ids of the variables to be read.
    keyframes: IntArray
    landmarks: IntArray
    in_graph: BoolArray  # (L,): which landmarks are variables at all
    is_whole: bool  # everything in the graph is read


def choose_part(submap: Submap, index: FactorIndex, entering: IntArray, window: int, everything: bool) -> Part:
    """Return the last `window` keyframes, those just added to, and what they see; with `READ_ALL` the whole graph.

    `everything`: all variables are read, though only the observations of that window are judged.
    """
    obs, rows = submap.observations, index.rows
    kf, lm = obs["kf"][: len(rows)], obs["landmark"][: len(rows)]
    # Rows of keyframes that were culled since the last plan are dead, but not out yet.
    inside = np.flatnonzero(rows["admitted"] & obs["alive"][: len(rows)])
    in_graph = take_mask(lm[rows["factor"] >= 0], len(submap.landmarks))
    keyframes, row = np.array(sorted(index.keyframes), np.int64), inside
    if window and len(keyframes) > window:
        recent = np.union1d(np.array(list(submap.keyframes)[-window:], np.int64), kf[entering])
        row = inside[take_mask(recent, int(max(kf.max(initial=0), recent.max())) + 1)[kf[inside]]]
        keyframes = keyframes if everything else recent
    else:
        everything = True
    seen = take_mask(lm[inside if everything else row], len(submap.landmarks))
    if everything:
        seen |= in_graph
    return Part(kf, lm, inside, row, keyframes, np.flatnonzero(seen & in_graph), in_graph, everything)


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Views of points: rows, the poses of their keyframes, and which of the poses and points each is of."""

    row: IntArray
    T_submap_kf: FloatArray
    pose: IntArray
    point: IntArray


def landmarks_beside(submap: Submap, inside: IntArray, in_graph: BoolArray, newest: list[int] | None) -> IntArray:
    """Return the landmarks of the rows `inside` that are no variables: those that keyframes see, or all (None)."""
    kf, lm = submap.observations["kf"][inside], submap.observations["landmark"][inside]
    if newest is not None:
        lm = lm[np.isin(kf, newest)]
    return np.flatnonzero(take_mask(lm, len(in_graph)) & ~in_graph)


def views_of(submap: Submap, ids: IntArray, inside: IntArray, poses: Mapping[int, FloatArray]) -> Views:
    """Return the views of landmarks among the rows `inside`; `poses` go before those of the submap."""
    obs = submap.observations
    row = inside[take_mask(ids, len(submap.landmarks))[obs["landmark"][inside]]]
    row = row[obs["alive"][row]]
    keyframes, pose = numbered(obs["kf"][row])
    T = [poses[k] if k in poses else submap.T_submap_kf[k] for k in keyframes.tolist()]
    return Views(row, se3.stack(T), pose, np.searchsorted(ids, obs["landmark"][row]))
