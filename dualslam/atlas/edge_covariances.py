"""Covariances of a submap's inner similarities, cached, and computed in the background."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from dualslam.atlas.warp import Warp
from dualslam.core.errors import SolverError
from dualslam.core.geometry import se3, sim3
from dualslam.core.jobs import Desk, JobKind
from dualslam.core.types import BoolArray, Failure, FailureReason, FloatArray, IntArray
from dualslam.map.submap import Submap

log = logging.getLogger(__name__)

SAME_TURN_RAD, SAME_WAY, SAME_SEEN = 0.02, 0.05, 0.2
"""Changes of an edge, and of how much its keyframes see, up to which its covariance is that of before."""

Covariances = Callable[[Submap, Sequence[tuple[int, int]], frozenset[int]], FloatArray]


def much_alike(then: FloatArray, now: FloatArray) -> BoolArray:
    """Return (...) for which edges (..., 4, 4) the covariance of before still holds."""
    change, way = np.abs(now - then), np.linalg.norm(se3.translation(then), axis=-1)
    turned_alike = se3.rotation(change).max(axis=(-2, -1)) < SAME_TURN_RAD
    return np.asarray(turned_alike & (se3.translation(change).max(axis=-1) < SAME_WAY * way))


@dataclass(frozen=True, slots=True, eq=False)
class _Known:
    """The covariance of an edge, and the state of the two keyframes for which it was computed."""

    T_first_second: FloatArray
    n_seen: IntArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class EdgeQuestion:
    """Edges of a submap whose covariances are asked for, and a snapshot of it."""

    submap: Submap
    pairs: tuple[tuple[int, int], ...]  # tuple of (int, int): keyframe ids
    held: frozenset[int]  # keyframes whose relative pose is no evidence


def answer_edges(question: EdgeQuestion, compute: Covariances) -> FloatArray | Failure:
    """Return the covariances (E, 7, 7) that a question asks for: a background job."""
    try:
        return compute(question.submap, question.pairs, question.held)
    except SolverError as error:
        log.warning("submap %d: %s", question.submap.id, error)
        return Failure(FailureReason.SOLVER, str(error))


class EdgeCovariances:
    """Covariances of edges within submaps, remembered as long as the edge's keyframes are much as they were.

    - `compute`: gives them from a submap's factors, here and now.
    - `desk`: computes those that are requested beforehand.
    """

    def __init__(self, compute: Covariances, desk: Desk) -> None:
        self._compute = compute
        self._desk = desk
        self._known: dict[tuple[int, int, int], _Known] = {}

    def __call__(self, submap: Submap, pairs: Sequence[tuple[int, int]], held: frozenset[int]) -> FloatArray:
        """Return (E, 7, 7)."""
        self._collect()
        return self._completed(submap, pairs, self._missing(submap, pairs), held)

    def as_foreseen(self, submap: Submap, pairs: Sequence[tuple[int, int]], held: frozenset[int]) -> FloatArray:
        """Return (E, 7, 7), also where the keyframes are not quite as they were: they were asked about a moment ago."""
        self._collect()
        unknown = [pair for pair in pairs if (submap.id, *pair) not in self._known]
        return self._completed(submap, pairs, unknown, held)

    def _completed(
        self, submap: Submap, pairs: Sequence[tuple[int, int]], new: list[tuple[int, int]], held: frozenset[int]
    ) -> FloatArray:
        """Compute those that are `new`, and return all."""
        if new:
            self._note(submap, new, self._compute(submap, new, held))
        return self._remembered(submap, pairs)

    def _remembered(self, submap: Submap, pairs: Sequence[tuple[int, int]]) -> FloatArray:
        return np.array([self._known[(submap.id, *pair)].covariance for pair in pairs]).reshape(-1, sim3.DOF, sim3.DOF)

    def foresee(self, submap: Submap, pairs: Sequence[tuple[int, int]], held: frozenset[int]) -> None:
        """Compute in the background those that are missing."""
        self._collect()
        if new := self._missing(submap, pairs):
            self._desk.submit(JobKind.EDGES, EdgeQuestion(submap.copy(), tuple(new), held))

    @property
    def foreseeing(self) -> bool:
        """Whether some are still being computed."""
        self._collect()
        return self._desk.n_open(JobKind.EDGES) > 0

    def _missing(self, submap: Submap, pairs: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
        known = [self._known.get((submap.id, *pair)) for pair in pairs]
        old = [i for i, one in enumerate(known) if one is not None]
        missing = np.ones(len(pairs), bool)
        if old:
            then = [one for one in known if one is not None]
            T, n_seen = _states(submap, [pairs[i] for i in old])
            was = np.array([one.n_seen for one in then])
            seen_alike = (np.abs(n_seen - was) <= SAME_SEEN * was).all(axis=1)
            missing[old] = ~(seen_alike & much_alike(np.array([one.T_first_second for one in then]), T))
        return [pairs[i] for i in np.flatnonzero(missing).tolist()]

    def _collect(self) -> None:
        for ended in self._desk.poll(JobKind.EDGES):
            if not isinstance(ended.result, Failure):  # else they are computed when they are needed
                self._note(ended.work.submap, ended.work.pairs, ended.result)

    def _note(self, submap: Submap, pairs: Sequence[tuple[int, int]], covariances: FloatArray) -> None:
        for pair, T, n_seen, C in zip(pairs, *_states(submap, pairs), covariances, strict=True):
            self._known[(submap.id, *pair)] = _Known(T, n_seen, C)

    def bent(self, submap: Submap, warp: Warp) -> None:
        """Take in that a submap stands otherwise by a solution of the atlas: its own factors say what they said."""
        kept = []
        for m, first, second in [key for key in self._known if key[0] == submap.id]:
            if first in submap.keyframes and second in submap.keyframes:
                kept.append((first, second))
            else:
                del self._known[m, first, second]
        units = np.ones((len(kept), sim3.DOF))
        units[:, 3:6] = sim3.scale(warp.at([second for _, second in kept]))[:, None]
        then = self._remembered(submap, kept)
        self._note(submap, kept, units[:, :, None] * then * units[:, None, :])


def _states(submap: Submap, pairs: Sequence[tuple[int, int]]) -> tuple[FloatArray, IntArray]:
    """Return for each pair of keyframes the pose between them (E, 4, 4), and how many landmarks they see (E, 2)."""
    keyframes, at = np.unique(np.array(pairs, np.int64).reshape(-1, 2), return_inverse=True)
    first, second = at.reshape(-1, 2).T
    T = submap.keyframe_poses(keyframes)
    n_seen = np.array([np.count_nonzero(submap.landmark_of[k] >= 0) for k in keyframes.tolist()], np.int64)
    return se3.inverse(T)[first] @ T[second], n_seen[at.reshape(-1, 2)]
