"""How submaps follow a solution of the atlas: all at once, or step by step between frames, the live one first."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from dualslam.atlas.bending import Move, bend_frames, bend_link, bend_submap, hold
from dualslam.atlas.edge_covariances import EdgeCovariances
from dualslam.atlas.record import Record
from dualslam.core.atlas_problem import AtlasSolver
from dualslam.core.interfaces import SubmapGraph, VisualOdometry
from dualslam.core.types import IntArray

REFITTED = 2000
"""Landmarks that are found again under their new poses in one step: 10 to 20 ms, where a full submap has 9,000."""


@dataclass(frozen=True, slots=True, eq=False)
class _Points:
    """Landmarks of a bent submap that are still to be found again under its new poses."""

    submap_id: int
    landmark_ids: IntArray


class Mover:
    """Bends submaps with all that lies in them; a submap bends in one step, and its points are made better in others.

    `record`, `solver`, `covariances`, `new_graph`, `front_ends`, `forget_graph`: see `Connections`.
    """

    def __init__(
        self,
        record: Record,
        solver: AtlasSolver,
        covariances: EdgeCovariances,
        new_graph: Callable[[], SubmapGraph],
        front_ends: Callable[[], Iterable[VisualOdometry]],
        forget_graph: Callable[[int], None] | None,
    ) -> None:
        self._record = record
        self._solver = solver
        self._covariances = covariances
        self._new_graph = new_graph
        self._front_ends = front_ends
        self._forget_graph = forget_graph
        self._left: list[Move | _Points] = []

    @property
    def is_moving(self) -> bool:
        """Whether some steps are left."""
        return bool(self._left)

    def make(self, moves: Sequence[Move]) -> None:
        """Make all moves of a solution at once."""
        self._bend(moves, refits=True)

    def begin(self, moves: Sequence[Move]) -> None:
        """Make the moves of a solution one by one; of what is live, now."""
        live = {front_end.submap.id for front_end in self._front_ends()}
        self._left += [move for move in moves if move.submap_id not in live]
        for move in moves:
            if move.submap_id in live:
                self._left = [move, *self._left]
                self.step()

    def step(self) -> None:
        """Make the next step, if any is left: bend a submap, or find some of its landmarks again."""
        if not self._left:
            return
        step = self._left.pop(0)
        if isinstance(step, _Points):
            self._refit(step.submap_id, step.landmark_ids)
            return
        self._bend([step], refits=False)
        newest_first = np.flatnonzero(self._record.atlas.submaps[step.submap_id].landmarks["alive"])[::-1]
        pieces = (newest_first[i : i + REFITTED] for i in range(0, len(newest_first), REFITTED))
        self._left = [*(_Points(step.submap_id, piece) for piece in pieces), *self._left]

    def complete(self) -> None:
        """Make all steps that are left."""
        while self._left:
            self.step()

    def leave(self, submap_id: int) -> None:
        """Make no more steps of a submap."""
        self._left = [step for step in self._left if step.submap_id != submap_id]

    def _bend(self, moves: Sequence[Move], refits: bool) -> None:
        atlas = self._record.atlas
        warps = {move.submap_id: move.warp for move in moves}
        ends = [link.attached(atlas) for link in atlas.links]
        befores = {m: atlas.submaps[m].copy() for m in warps}
        for move in moves:
            m, warp = move.submap_id, move.warp
            submap = atlas.submaps[m]
            bend_submap(submap, warp)
            for pose in bend_frames(self._record.poses.values(), befores[m], submap, warp):
                self._record.poses[pose.index] = pose
            atlas.warps[m] = warp.after(atlas.warps[m]) if m in atlas.warps else warp
            atlas.held[m] = hold(submap, warp.index.tolist(), move.steps, atlas.held.get(m, frozenset()))
            if refits:
                self._refit(m, np.arange(len(submap.landmarks)))
            self._covariances.bent(submap, warp)
            if self._forget_graph is not None:
                self._forget_graph(m)
        for i, (link, attached) in enumerate(zip(atlas.links, ends, strict=True)):
            if link.a in warps or link.b in warps:
                atlas.links[i] = bend_link(link, attached, warps)
        for front_end in self._front_ends():
            if front_end.submap.id in befores:
                front_end.adopt(self._new_graph(), befores[front_end.submap.id])

    def _refit(self, submap_id: int, landmark_ids: IntArray) -> None:
        submap = self._record.atlas.submaps[submap_id]
        submap.landmarks["xyz_mu"][landmark_ids] = self._solver.refit_points(submap, landmark_ids)
