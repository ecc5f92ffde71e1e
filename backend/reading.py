"""Which part of a graph's estimate is read after an update, and by which observations it is judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualslam.backend.factor_index import FactorIndex
from dualslam.backend.observability import take_mask
from dualslam.core.types import BoolArray, IntArray
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
