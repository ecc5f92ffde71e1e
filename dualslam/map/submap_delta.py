"""Changes of a submap since its replica was updated: how a graph in another process follows the arrays.

A replica holds what a graph needs of a submap: poses, points, pixels with their sigmas, observations, gauge. Keyframes
and rows that were added go there once, and of the rest only what died or moved: tens of kilobytes a keyframe, where the
whole is megabytes. The first delta of a replica holds everything.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dualslam.core.interfaces import SubmapGraph
from dualslam.core.types import Features, FloatArray, IntArray, Keyframe
from dualslam.map.anchors import Anchor, RelativePose
from dualslam.map.submap import NO_LANDMARK, Submap

N_RECENT = 8
"""Keyframes whose poses and landmarks are sent each time: the window adjustment has moved them."""
NO_DESCRIPTORS = np.zeros((0, 1), np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class SubmapDelta:
    """A change of a replica. It can be pickled."""

    submap_id: int
    is_whole: bool  # whether it holds the whole submap: the replica is made anew
    K: FloatArray  # (3, 3)
    gauge: tuple[int, int]
    keyframes: tuple[Keyframe, ...]
    """Those added, and those that have more features now: pixels and sigmas only, in the submap's order."""
    poses: dict[int, FloatArray]  # dict of int to (4, 4): of those, and of the newest ones
    removed: dict[int, Anchor | None]  # keyframes that were culled
    relative_poses: dict[int, RelativePose | None]  # those that have changed; None: gone
    landmarks: IntArray  # (L,): rows whose points come with it, those added included
    xyz_mu: FloatArray  # (L, 3)
    first_kf: IntArray  # (L,)
    n_landmarks: int  # rows of the table
    kept_rows: IntArray | None
    """(R,): rows of the replica's observations that stay in its table, if some do not; others are named as after that.
    """
    # Landmarks and observations that have died.
    dead_landmarks: IntArray
    dead_rows: IntArray
    # Observations added.
    kf: IntArray
    feature: IntArray
    landmark: IntArray
    alive: NDArray[np.bool_]

    def apply(self, replica: Submap | None) -> Submap:
        """Bring a replica up to date; a whole delta makes one."""
        if self.is_whole or replica is None:
            replica = Submap(self.submap_id, self.K, NO_DESCRIPTORS[:0].reshape(0))
        replica.K, replica.gauge = self.K, self.gauge
        self._keyframes(replica)
        lm = replica.landmarks
        if (n_new := self.n_landmarks - len(lm)) > 0:
            lm.append(n_new, alive=True, replaced_by=NO_LANDMARK)
        lm["xyz_mu"][self.landmarks] = self.xyz_mu
        lm["first_kf"][self.landmarks] = self.first_kf
        lm["alive"][self.dead_landmarks] = False
        if self.kept_rows is not None:
            replica.keep_observations(self.kept_rows)
        replica.remove_observations(self.dead_rows)
        obs = replica.observations
        obs.append(len(self.kf), kf=self.kf, feature=self.feature, landmark=self.landmark, alive=self.alive)
        for k in np.unique(self.kf[self.alive]).tolist():
            here = self.alive & (self.kf == k)
            if k in replica.landmark_of:
                replica.landmark_of[k][self.feature[here]] = self.landmark[here]
        return replica

    def _keyframes(self, replica: Submap) -> None:
        for k, anchor in self.removed.items():
            for table in (replica.keyframes, replica.T_submap_kf, replica.landmark_of):
                table.pop(k, None)
            if anchor is not None:
                replica.anchors[k] = anchor
        for keyframe in self.keyframes:
            known = replica.landmark_of.get(keyframe.id, np.zeros(0, np.int64))
            ids = np.full(len(keyframe.features), NO_LANDMARK, np.int64)
            ids[: len(known)] = known
            replica.keyframes[keyframe.id], replica.landmark_of[keyframe.id] = keyframe, ids
        for k, T in self.poses.items():
            replica.T_submap_kf[k] = T
        for k, relative in self.relative_poses.items():
            if relative is None:
                replica.relative_poses.pop(k, None)
            else:
                replica.relative_poses[k] = relative


class SubmapMirror:
    """Knows what a replica knows, and tells what it lacks."""

    def __init__(self) -> None:
        self._features: dict[int, Features] = {}
        self._relative: dict[int, RelativePose] = {}
        self._row_alive = np.zeros(0, bool)
        self._landmark_alive = np.zeros(0, bool)
        self._K: FloatArray | None = None
        self._n_dropped = 0
        self._kept_rows: IntArray | None = None  # what is to be sent to the replica

    @property
    def knows_replica(self) -> bool:
        """Whether there has been a delta: the next one need not be whole."""
        return self._K is not None

    def rows_out(self, submap: Submap) -> IntArray:
        """Return the rows that were dead in the last delta: a graph that has taken it in is done with them."""
        return np.flatnonzero(~self._row_alive if submap.n_dropped == self._n_dropped else self._row_alive[:0])

    def keep_rows(self, rows: IntArray) -> None:
        """Take in, for the next delta, that only these rows have stayed in the submap's table."""
        own = rows[rows < len(self._row_alive)]
        self._n_dropped += len(self._row_alive) - len(own)
        self._row_alive = self._row_alive[own]
        self._kept_rows = own if self._kept_rows is None else self._kept_rows[own]

    def delta(self, submap: Submap) -> SubmapDelta:
        """Return what brings the replica up to date, or makes it anew if camera or rows have changed, and take it as
        done.
        """
        renumbered = submap.n_dropped != self._n_dropped
        is_new = self._K is None or renumbered or bool((self._K != submap.K).any())
        if is_new:
            self._features, self._relative = {}, {}
            self._row_alive, self._landmark_alive = np.zeros(0, bool), np.zeros(0, bool)
            self._kept_rows = None
        obs, lm = submap.observations, submap.landmarks
        n_rows, n_points = len(self._row_alive), len(self._landmark_alive)
        added = [k for k, kf in submap.keyframes.items() if self._features.get(k) is not kf.features]
        removed = {k: submap.anchors.get(k) for k in self._features if k not in submap.keyframes}
        recent = list(submap.keyframes)[-N_RECENT:]
        relative: dict[int, RelativePose | None] = {
            k: r for k, r in submap.relative_poses.items() if self._relative.get(k) is not r
        }
        relative |= {k: None for k in self._relative if k not in submap.relative_poses}
        points = np.union1d(np.arange(n_points, len(lm)), submap.landmarks_of_keyframes(recent))
        new_rows = slice(n_rows, len(obs))
        made = SubmapDelta(
            submap_id=submap.id,
            is_whole=is_new,
            K=submap.K,
            gauge=submap.gauge,
            keyframes=tuple(_slim(submap.keyframes[k]) for k in added),
            poses={k: submap.T_submap_kf[k].copy() for k in dict.fromkeys((*added, *recent))},
            removed=removed,
            relative_poses=relative,
            landmarks=points,
            xyz_mu=lm["xyz_mu"][points],
            first_kf=lm["first_kf"][points],
            n_landmarks=len(lm),
            kept_rows=self._kept_rows,
            dead_landmarks=np.flatnonzero(_died(self._landmark_alive, lm["alive"])),
            dead_rows=np.flatnonzero(self._row_alive & ~obs["alive"][:n_rows]),
            kf=obs["kf"][new_rows].copy(),
            feature=obs["feature"][new_rows].copy(),
            landmark=obs["landmark"][new_rows].copy(),
            alive=obs["alive"][new_rows].copy(),
        )
        self._K, self._n_dropped, self._kept_rows = submap.K.copy(), submap.n_dropped, None
        self._features = {k: kf.features for k, kf in submap.keyframes.items()}
        self._relative = dict(submap.relative_poses)
        self._row_alive, self._landmark_alive = obs["alive"].copy(), lm["alive"].copy()
        return made


def _died(before: NDArray[np.bool_], now: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which are dead now and were not known to be: those that have come since count as alive before."""
    known = np.ones(len(now), bool)
    known[: len(before)] = before
    return known & ~now


def _slim(keyframe: Keyframe) -> Keyframe:
    """A keyframe's data for a graph: pixels and their sigmas."""
    f, none = keyframe.features, np.zeros(0)
    slim = Features(f.uv_rect_px, f.uv_rect_px, f.sigma_px, none, np.zeros(0, np.int64), none, NO_DESCRIPTORS)
    return replace(keyframe, features=slim)


MIN_DEAD = 10_000
"""Dead rows at least: with what the graph knows of each they are 0.6 MB, and below it no operation over them counts."""

log = logging.getLogger(__name__)


def drop_dead_rows(submap: Submap, graph: SubmapGraph) -> int:
    """Take out of a submap's table the rows that are dead and followed no more, once they outnumber the live ones.

    `graph`: all that follows this submap by the numbers of its rows. Returns how many rows have gone.
    """
    n, n_alive = len(submap.observations), int(np.count_nonzero(submap.observations["alive"]))
    least = max(MIN_DEAD, n_alive + 1)
    if n - n_alive < least:  # at most frames: the follower is not asked
        return 0
    rows = graph.rows_out(submap)
    if len(rows) < least:
        return 0
    stays = np.ones(n, np.bool_)
    stays[rows] = False
    kept = np.flatnonzero(stays)
    submap.keep_observations(kept)
    graph.keep_rows(kept)
    log.info("submap %d: %d of %d observations were dead and have left the table", submap.id, len(rows), n)
    return len(rows)
