"""How submaps follow a solution of the atlas: all at once, or step by step between frames, the live one first.

A solution bends a submap: keyframes, landmarks, culled keyframes and frames follow one field.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dualslam.atlas.atlas import Link
from dualslam.atlas.edge_covariances import EdgeCovariances
from dualslam.atlas.record import Record
from dualslam.atlas.trajectory import FramePose
from dualslam.atlas.warp import Warp
from dualslam.core.atlas_problem import AtlasSolver
from dualslam.core.geometry import se3, sim3
from dualslam.core.interfaces import SubmapGraph, VisualOdometry
from dualslam.core.types import FloatArray, IntArray
from dualslam.map.anchors import RelativePose
from dualslam.map.submap import Submap

REFITTED = 2000
"""Landmarks that are found again under their new poses in one step: 10 to 20 ms, where a full submap has 9,000."""


@dataclass(frozen=True, slots=True, eq=False)
class _Points:
    """Landmarks of a bent submap that are still to be found again under its new poses."""

    submap_id: int
    landmark_ids: IntArray


class Mover:
    """Bends submaps with all that lies in them, and makes their points better in later steps; arguments: see
    `Connections`.
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


HOLD_RATIO = 1 / 3
"""Sigma of a relative pose that holds a bend, over that of what the submap's own factors say there: nine tenths of the
bend outlast a new solution of the submap."""


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """Effect of a solution on one submap."""

    submap_id: int
    warp: Warp  # acts from the left, in the submap's frame
    S_world_submap: FloatArray  # (4, 4): where the solution puts the frame
    bend_mu: float  # farthest that a keyframe goes
    bent: bool  # whether any goes anywhere
    steps: FloatArray
    """(K - 1, 7, 7): covariances from knot to knot of the warp, as the submap's own factors give them."""


def bend_submap(submap: Submap, warp: Warp) -> None:
    """Move everything that a submap holds.

    Each keyframe goes by the similarity at its frame, whose scale goes into the points around it. Landmarks go with the
    keyframe that described them first, so that what a keyframe sees of its own keeps its pixels.
    """
    keyframe_ids, culled = list(submap.keyframes), list(submap.anchors)
    T_culled = [submap.resolve_anchor(a.keyframe_id, a.T_kf_cam) for a in submap.anchors.values()]
    S = warp.at(keyframe_ids)
    scales = dict(zip(keyframe_ids, sim3.scale(S).tolist(), strict=True))
    for k, T in zip(keyframe_ids, sim3.act_on_pose(S, submap.keyframe_poses(keyframe_ids)), strict=True):
        submap.T_submap_kf[k] = T
    if culled:
        moved = sim3.act_on_pose(warp.at(culled), np.array(T_culled))
        for k, T in zip(culled, moved, strict=True):
            submap.anchors[k] = submap.anchored(k, T)
    for k, known in submap.relative_poses.items():
        submap.relative_poses[k] = known.scaled(scales[k])
    lm = submap.landmarks
    if len(lm):
        S_lm = warp.at(lm["first_kf"])
        lm["xyz_mu"][:] = sim3.act_each(S_lm, lm["xyz_mu"])
        lm["normal"][:] = np.einsum("nij,nj->ni", sim3.rotation(S_lm), lm["normal"])
        lm["distance_mu"][:] *= sim3.scale(S_lm)


def bend_frames(poses: Iterable[FramePose], before: Submap, after: Submap, warp: Warp) -> list[FramePose]:
    """Return the frames of a bent submap where they are now, relative to the same keyframes, or to their heirs."""
    own = [p for p in poses if p.submap_id == after.id and p.index not in after.keyframes]
    if not own:
        return []
    T = np.array([before.resolve_anchor(p.keyframe_id, p.T_kf_cam) for p in own])
    moved = sim3.act_on_pose(warp.at([p.index for p in own]), T)
    stays = [after.keyframe_for(pose.keyframe_id) for pose in own]
    T_kf_cam = se3.inverse(np.array([after.T_submap_kf[k] for k in stays])) @ moved
    return [replace(pose, keyframe_id=k, T_kf_cam=T) for pose, k, T in zip(own, stays, T_kf_cam, strict=True)]


def bend_link(link: Link, attached: tuple[int, int], warps: dict[int, Warp]) -> Link:
    """Return a link as it is measured in submaps that have been bent: the same measurement, the same residual."""
    k_a, k_b = attached
    S_a_b, covariance = link.S_a_b, link.covariance
    if link.a in warps:
        S_a_b = warps[link.a].at([k_a])[0] @ S_a_b
    if link.b in warps:
        S = warps[link.b].at([k_b])[0]
        Ad = sim3.adjoint(S)
        S_a_b, covariance = S_a_b @ sim3.inverse(S), Ad @ covariance @ Ad.T
    return replace(link, S_a_b=S_a_b, covariance=covariance)


def hold(submap: Submap, knots: Sequence[int], covariances: FloatArray, held: frozenset[int]) -> frozenset[int]:
    """Let relative poses from knot to knot hold a submap's shape; return the keyframes that have one.

    A submap's own graph knows its projections only, and would straighten itself out. What another front end said of a
    keyframe (a gap relocalisation) is not written over.

    - `knots`: keyframes, ascending.
    - `covariances` (K - 1, 7, 7): of the similarities between neighbours, as the submap's own factors give them.
    - `held`: keyframes that hold an earlier bend so.
    """
    for k in held:
        submap.relative_poses.pop(k, None)
    now = set()
    for first, second, C in zip(knots[:-1], knots[1:], covariances, strict=True):
        if second in submap.relative_poses or not {first, second} <= submap.keyframes.keys():
            continue
        T = se3.inverse(submap.T_submap_kf[first]) @ submap.T_submap_kf[second]
        submap.relative_poses[second] = RelativePose(first, T, HOLD_RATIO**2 * C[:6, :6])
        now.add(second)
    return frozenset(now)
