"""The camera's path in the map, by time, and readings attached to the nodes of the pose graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dualslam.core.geometry import se3, sim3
from dualslam.core.metric_problem import MeasurementSource, MetricProblem
from dualslam.core.types import BoolArray, FloatArray, IntArray

MAX_GAP_S = 1.0
"""Between two posed frames: across a longer gap no pose is interpolated."""


class CameraPath:
    """Poses of a linked set of submaps at any time."""

    def __init__(self, problem: MetricProblem) -> None:
        self._t, self._T, self._node = problem.times_s, problem.T_world_cam, problem.node
        self._S_node_world = sim3.inverse(problem.S_world_node)

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time."""
        return float(self._t[0]), float(self._t[-1])

    def knows(self, times_s: FloatArray) -> BoolArray:
        """Whether there is a pose at each time."""
        after = np.clip(np.searchsorted(self._t, times_s, side="right"), 1, len(self._t) - 1)
        inside = (times_s >= self._t[0]) & (times_s <= self._t[-1])
        return np.asarray(inside & (self._t[after] - self._t[after - 1] <= MAX_GAP_S))

    def at(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
        """Return poses (M, 4, 4), twists (M, 6) in the camera's axes per second, and nodes (M,) at known times."""
        after = np.clip(np.searchsorted(self._t, times_s, side="right"), 1, len(self._t) - 1)
        before = after - 1
        step = self._t[after] - self._t[before]
        share = np.clip((times_s - self._t[before]) / step, 0.0, 1.0)
        xi = se3.log(se3.inverse(self._T[before]) @ self._T[after])
        T = self._T[before] @ se3.exp(share[:, None] * xi)
        node = np.where(share < 0.5, self._node[before], self._node[after])
        return T, xi / step[:, None], node

    def at_nodes(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
        """Return the same, poses and twists in the frames and units of the nodes."""
        T, twist, node = self.at(times_s)
        S = self._S_node_world[node]
        twist[:, 3:] *= sim3.scale(S)[:, None]
        return sim3.act_on_pose(S, T), twist, node


@dataclass(slots=True, eq=False)
class Term:
    """A reading with the poses that it is about, at the clock's offset that `attach` was given."""

    reading: Any
    source: int
    nodes: tuple[int, ...]  # one for each pose; they may be equal
    T_node_cam: FloatArray  # (k, 4, 4)
    twist: FloatArray  # (k, 6): in the node's unit
    weight: float = 1.0


def attach(
    path: CameraPath, sources: Sequence[MeasurementSource], offsets_s: Sequence[float]
) -> tuple[list[Term], list[Any]]:
    """Attach the readings whose times have poses; return them and the others. `offsets_s`: of the sources' clocks."""
    terms: list[Term] = []
    outside: list[Any] = []
    for i, (source, offset) in enumerate(zip(sources, offsets_s, strict=True)):
        if not source.readings:
            continue
        counts = np.array([len(r.times_s) for r in source.readings])
        times = np.array([t for r in source.readings for t in r.times_s]) + offset
        known = path.knows(times)
        T, twist, node = path.at_nodes(times)
        ends = np.cumsum(counts)
        for reading, a, b in zip(source.readings, (ends - counts).tolist(), ends.tolist(), strict=True):
            if known[a:b].all():
                terms.append(Term(reading, i, tuple(node[a:b].tolist()), T[a:b], twist[a:b]))
            else:
                outside.append(reading)
    return terms, outside
