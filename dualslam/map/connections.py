"""The one way in which maps are joined and moved: connections come in, the atlas is solved, every submap follows.

All that a solution moves is moved in one go: keyframes, landmarks, culled keyframes, frames, links with their
covariances, the live front end. Graphs are not: they follow the arrays, and are made anew when they are asked next.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import pairwise

from dualslam.core.atlas_problem import AtlasSolver
from dualslam.core.bundle import BundleAdjuster
from dualslam.core.errors import SolverError
from dualslam.core.events import EventKind
from dualslam.core.geometry import sim3
from dualslam.core.interfaces import SubmapGraph, VisualOdometry
from dualslam.core.types import Failure, FailureReason, FloatArray, IntArray
from dualslam.map.atlas import Atlas, Link, LinkKind, joined
from dualslam.map.atlas_report import (
    AtlasReport,
    Solved,
    changes_nothing,
    count_kinds,
    moves_of,
    named,
    placed_by,
    together,
)
from dualslam.map.bending import Move, bend_frames, bend_link, bend_submap, hold
from dualslam.map.overlap_sides import OverlapRefinement, apply_overlap, overlap_problem
from dualslam.map.propagation import propagate_anchors, propagate_links, propagate_poses
from dualslam.map.record import FrameStamp, Record
from dualslam.map.skeleton import Covariances, EdgeCovariances, Skeleton, build_skeleton, skeleton_knots
from dualslam.map.submap import Submap
from dualslam.workers.jobs import Desk

log = logging.getLogger(__name__)


class Connections:
    """Joins submaps, solves the atlas, and lets everything follow.

    Parameters
    ----------
    record : Record
    solver : AtlasSolver
    new_graph : callable
        Makes an empty graph, for a front end whose submap has been bent.
    adjust : BundleAdjuster
        Of overlaps.
    desk : Desk
        Where covariances are computed that are needed soon.
    front_ends : callable
        Gives those that go on, or may go on, in a submap of the atlas.
    """

    def __init__(
        self,
        record: Record,
        solver: AtlasSolver,
        new_graph: Callable[[], SubmapGraph],
        adjust: BundleAdjuster,
        desk: Desk,
        front_ends: Callable[[], Iterable[VisualOdometry]] = tuple,
    ) -> None:
        self._record = record
        self._solver = solver
        self._new_graph = new_graph
        self._adjust = adjust
        self._front_ends = front_ends
        self._covariances = EdgeCovariances(solver.edge_covariances, desk)

    @property
    def _atlas(self) -> Atlas:
        return self._record.atlas

    # --- what others ask for

    def connect(self, links: Sequence[Link], now: FrameStamp) -> AtlasReport:
        """Take connections in, solve what they join, and move all that the solution moves.

        Parameters
        ----------
        links : sequence of Link
        now : FrameStamp
            For the event log.

        Returns
        -------
        AtlasReport
            Falsy where the solver failed: the connections are not taken in then.
        """
        touched = {m for link in links for m in (link.a, link.b)}
        report = self._solve(touched, links, now)
        for link in links if report else ():
            if link.kind is LinkKind.ROLLOVER:
                self._foresee_rollover(link.a)
        return report

    def foresee(self, link: Link) -> None:
        """Have computed beside the tracking what the solution with a connection to come needs of the submaps."""
        self._skeleton({link.a, link.b}, (link,), self._covariances.foresee)

    @property
    def foreseeing(self) -> bool:
        """Whether that is still being computed."""
        return self._covariances.foreseeing

    def follow(self, before: Submap, after: Submap, now: FrameStamp) -> None:
        """Let all that is known against a submap follow a change that its own graph has made.

        Frames, culled keyframes and links go along; where the submap lies on a cycle the atlas is solved again.

        Parameters
        ----------
        before, after : Submap
            Two states of it; `after` is the one in the atlas.
        now : FrameStamp
            For the event log.
        """
        self._carry(before, after)
        if after.id in self._atlas.placement:
            self._solve({after.id}, (), now)

    def _carry(self, before: Submap, after: Submap) -> None:
        for pose in propagate_poses(self._record.poses.values(), before, after):
            self._record.poses[pose.index] = pose
        propagate_anchors(before, after)
        propagate_links(self._atlas, before, after)
        if held := self._atlas.held.get(after.id):
            self._atlas.held[after.id] = frozenset(k for k in held if k in after.relative_poses)
            if not self._atlas.held[after.id]:  # another camera forgets them all: its graph has taken the bend out
                self._atlas.warps.pop(after.id, None)

    def settle(self, now: FrameStamp) -> None:
        """Solve all sets with cycles once more, as their submaps are by now."""
        for component in self._atlas.components():
            if component[0] in self._atlas.placement:
                self._solve(set(component), (), now)

    def relative(self, a: tuple[int, int], b: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        """Return ``S_ka_kb`` between two keyframes, each a submap and an id there, and its (7, 7) covariance.

        It goes through the whole atlas, by connections that are believed, also across submaps.

        Raises
        ------
        SolverError
            If the two are not connected, or the solver cannot tell.
        """
        component = next(c for c in self._atlas.components() if a[0] in c)
        if b[0] not in component:
            raise SolverError(f"submaps {a[0]} and {b[0]} are not connected: keyframes in them have no relative pose")
        links = [link for link in self._atlas.believed if link.a in component]
        more = {m: {k for n, k in (a, b) if n == m} for m in (a[0], b[0])}
        skeleton = build_skeleton(self._atlas, component, links, self._covariances, lambda link: True, more, True)
        first, second = (skeleton.nodes.index(node) for node in (a, b))
        S = skeleton.problem.S_world_node
        return sim3.inverse(S[first]) @ S[second], self._solver.relative_covariance(skeleton.problem, first, second)

    def refine_overlap(self, link: Link, landmark_pairs: IntArray) -> OverlapRefinement | Failure:
        """Refine keyframes and landmarks about a connection together, on both of its sides, live or archived.

        Parameters
        ----------
        link : Link
            One that has been taken in.
        landmark_pairs : (I, 2) int64
            Landmarks of its two submaps that are the same point; those of frames that both hold are known already.

        Returns
        -------
        OverlapRefinement or Failure
            `TOO_FEW_MATCHES` where too few points are seen from both sides; nothing has changed then.
        """
        sides = self._atlas.submaps[link.a], self._atlas.submaps[link.b]
        component = next(c for c in self._atlas.components() if link.a in c)
        S_world = self._atlas.S_world_submap(component)
        S_a_b = sim3.inverse(S_world[link.a]) @ S_world[link.b]
        refinement = overlap_problem(sides, link.attached(self._atlas), S_a_b, landmark_pairs)
        if isinstance(refinement, Failure):
            return refinement
        try:
            result = self._adjust(refinement.problem)
        except SolverError as error:
            return Failure(FailureReason.SOLVER, str(error))
        befores = {submap.id: submap.copy() for submap in sides}
        moved = apply_overlap(sides, refinement, result)
        for m, before in befores.items():
            for front_end in self._front_ends():
                if front_end.submap.id == m:
                    front_end.adopt(self._new_graph(), before)
            self._carry(before, self._atlas.submaps[m])
        # The pixels of both sides have said how they stand to each other: that is the measurement now.
        self._atlas.links = [
            replace(other, S_a_b=S_a_b) if other.attached_as(link) else other for other in self._atlas.links
        ]
        return OverlapRefinement(
            n_keyframes=int((~refinement.problem.fixed).sum()),
            n_landmarks=len(refinement.problem.xyz_mu),
            n_joined=refinement.n_joined,
            n_observations=len(refinement.problem.kf),
            cost_before=result.cost_before,
            cost_after=result.cost_after,
            moved=moved,
        )

    # --- solving

    def _skeleton(self, touched: set[int], new: Sequence[Link], covariances: Covariances | None = None) -> Skeleton:
        """Make the problem of the linked set that new connections make of what they touch."""
        links = [*self._atlas.links, *new]
        component = next(c for c in joined(self._atlas.submaps, links) if touched & set(c))
        within = [link for link in links if link.a in component]
        fresh = set(map(id, new))
        return build_skeleton(
            self._atlas,
            component,
            within,
            covariances or self._covariances,
            lambda link: id(link) not in fresh and not link.rejected,
        )

    def _solve(self, touched: set[int], new: Sequence[Link], now: FrameStamp) -> AtlasReport:
        started = time.perf_counter()
        solved: list[Solved] = []
        try:
            while touched:
                skeleton = self._skeleton(touched, [link for link in new if link.a in touched])
                solution = self._solver.solve(skeleton.problem)
                moves: list[Move] | None = None
                if not new or not changes_nothing(skeleton, solution, new):
                    moves = [] if skeleton.is_tree else moves_of(self._atlas, skeleton, solution)
                bent = [move.submap_id for move in moves or () if move.bent]
                holds = {m: self._to_hold(skeleton, m) for m in bent}
                solved.append(Solved(skeleton, solution, moves, holds))
                touched = touched - set(skeleton.component)
        except SolverError as error:
            log.warning("the atlas stays as it is: %s", error)
            return AtlasReport(failure=Failure(FailureReason.SOLVER, str(error)))
        self._atlas.links.extend(new)
        report = replace(together([self._apply(s) for s in solved]), seconds=time.perf_counter() - started)
        self._tell(report, solved, now)
        return report

    def _foresee_rollover(self, submap_id: int) -> None:
        """Ask a full submap for its covariances now: the first loop of a long run would wait for those of all."""
        submap = self._atlas.submaps[submap_id]
        pairs = list(pairwise(skeleton_knots(submap)))
        self._covariances.foresee(submap, pairs, self._atlas.held.get(submap_id, frozenset()))

    def _to_hold(self, skeleton: Skeleton, submap_id: int) -> tuple[list[int], FloatArray]:
        """Return the knots that are to hold a submap's bend, and what its own factors say from one to the next."""
        _, knots = skeleton.knots(submap_id)
        pairs = list(pairwise(knots))
        held = self._atlas.held.get(submap_id, frozenset())
        return knots, self._covariances(self._atlas.submaps[submap_id], pairs, held)

    # --- the transaction

    def _apply(self, solved: Solved) -> AtlasReport:
        """Move all that a solution moves. Whatever can fail has been done before."""
        atlas, skeleton = self._atlas, solved.skeleton
        ends = {id(link): link.attached(atlas) for link in skeleton.links}
        moves = solved.moves or []
        warps = {move.submap_id: move.warp for move in moves if move.bent}
        befores = {m: atlas.submaps[m].copy() for m in warps}
        for m, warp in warps.items():
            submap = atlas.submaps[m]
            bend_submap(submap, warp)
            for pose in bend_frames(self._record.poses.values(), befores[m], submap, warp):
                self._record.poses[pose.index] = pose
            atlas.warps[m] = warp.after(atlas.warps[m]) if m in atlas.warps else warp
            atlas.held[m] = hold(submap, *solved.holds[m], atlas.held.get(m, frozenset()))
            submap.landmarks["xyz_mu"][:] = self._solver.refit_points(submap)
            self._covariances.bent(submap, warp)
        if solved.moves is not None:
            for m in skeleton.component:
                atlas.placement.pop(m, None)
            atlas.placement |= {move.submap_id: move.S_world_submap for move in moves}
        believed = dict(zip(map(id, skeleton.links), solved.believed, strict=True))
        changed: dict[bool, list[Link]] = {True: [], False: []}
        for i, link in enumerate(atlas.links):
            if id(link) not in believed:
                continue
            kept = believed[id(link)]
            atlas.links[i] = replace(bend_link(link, ends[id(link)], warps), rejected=not kept)
            if kept == link.rejected:
                changed[kept].append(atlas.links[i])
        for front_end in self._front_ends():
            if front_end.submap.id in befores:
                front_end.adopt(self._new_graph(), befores[front_end.submap.id])
        return AtlasReport(
            rejected=tuple(k for k in atlas.links if k.rejected and k.a in skeleton.component),
            newly_rejected=tuple(changed[False]),
            readmitted=tuple(changed[True]),
            factors=count_kinds(e for e, kept in zip(solved.edges, solved.solution.believed, strict=True) if kept),
            cost_before=solved.solution.cost_before,
            cost_after=solved.solution.cost_after,
            drift=solved.solution.drift,
            newest_chi2=solved.newest_chi2,
            bent={move.submap_id: move.bend_mu for move in moves if move.bent},
            placed=placed_by(skeleton, solved.solution) if solved.moves is not None else {},
        )

    def _tell(self, report: AtlasReport, solved: Sequence[Solved], now: FrameStamp) -> None:
        self._record.event(
            EventKind.ATLAS_SOLVED,
            now,
            solved[0].skeleton.component[0],
            submaps=[m for each in solved for m in each.skeleton.component],
            factors=report.factors,
            cost_before=report.cost_before,
            cost_after=report.cost_after,
            drift=report.drift,
            rejected=[{"submap": link.b, **named(link)} for link in report.rejected],
            bent={str(m): bend for m, bend in report.bent.items()},
            largest_bend=max(report.bent.values(), default=0.0),
            largest_move=max(report.placed.values(), default=0.0),
            seconds=report.seconds,
        )
        for kind, links in (
            (EventKind.CONNECTION_REJECTED, report.newly_rejected),
            (EventKind.CONNECTION_READMITTED, report.readmitted),
        ):
            for link in links:
                self._record.event(kind, now, link.b, **named(link))
