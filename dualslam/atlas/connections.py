"""The one way in which maps are joined and moved: connections come in, the atlas is solved, every submap follows.

All that a solution moves is moved in one go: keyframes, landmarks, culled keyframes, frames, links with their
covariances, the live front end. Graphs are not: they follow the arrays, and are made anew when they are asked next.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

from dualslam.atlas.atlas import Atlas, Link, LinkKind
from dualslam.atlas.beside import AskedSolution, AtlasProblems
from dualslam.atlas.moving import Mover
from dualslam.atlas.propagation import propagate_anchors, propagate_links, propagate_poses
from dualslam.atlas.record import FrameStamp, Record
from dualslam.atlas.report import AtlasReport, Solved, tell, together
from dualslam.atlas.skeleton import Skeleton
from dualslam.core.atlas_problem import AtlasSolution, AtlasSolver
from dualslam.core.errors import SolverError
from dualslam.core.interfaces import SubmapGraph, VisualOdometry
from dualslam.core.jobs import Desk, JobKind
from dualslam.core.noise_model import MAX_TRIES
from dualslam.core.types import Failure, FailureReason
from dualslam.map.submap import Submap

log = logging.getLogger(__name__)


class Connections:
    """Joins submaps, solves the atlas, and lets everything follow.

    - `new_graph`: makes an empty graph, for a front end whose submap has been bent.
    - `desk`: where solutions are computed, and covariances that they will need.
    - `front_ends`: gives those that go on, or may go on, in a submap of the atlas.
    - `forget_graph`: called with each submap that has been bent: what its graph is solving is of before.
    """

    def __init__(
        self,
        record: Record,
        solver: AtlasSolver,
        new_graph: Callable[[], SubmapGraph],
        desk: Desk,
        front_ends: Callable[[], Iterable[VisualOdometry]] = tuple,
        forget_graph: Callable[[int], None] | None = None,
    ) -> None:
        self._record = record
        self._solver = solver
        self._desk = desk
        self._problems = AtlasProblems(record, solver, desk)
        self._mover = Mover(record, solver, self._problems.covariances, new_graph, front_ends, forget_graph)
        self._asked: AskedSolution | None = None  # what is being solved in the background
        self._due: set[int] = set()  # submaps whose linked sets are to be solved next
        self._is_due_foreseen = False
        self._changes: dict[int, int] = {}  # by submap: how many times others than its graph have changed it
        self._is_over = False

    @property
    def _atlas(self) -> Atlas:
        return self._record.atlas

    # --- what others ask for

    def connect(self, links: Sequence[Link], now: FrameStamp) -> AtlasReport:
        """Take connections in, solve what they join, and move all that the solution moves.

        A connection that alone ties two sets contradicts nothing: where its solution is not there at once, the sets
        are joined by it as they are, and move when it comes.

        `now`: for the event log.

        Returns AtlasReport: falsy where the solver failed: the connections are not taken in then.
        """
        touched = {m for link in links for m in (link.a, link.b)}
        if len(links) > 1 or self._are_connected(touched):
            self._mover.complete()
            report = self._solve(touched, links, now)
        else:
            report = self._connect_sets(links[0], now)
        for link in links if report else ():
            if link.kind is LinkKind.ROLLOVER:
                self._problems.foresee_rollover(link.a)
        return report

    def tighten(self, link: Link, now: FrameStamp) -> bool:
        """Replace the unsure connection of this kind between two submaps, if `link` is surer; return whether it is."""
        links = self._atlas.links
        ends = link.a, link.b, link.kind
        unsure = (i for i, known in enumerate(links) if (known.a, known.b, known.kind) == ends and not known.is_sure)
        row = next(unsure, None)
        if row is None or not (link.is_sure or link.sigma_scale < links[row].sigma_scale):
            return False
        links[row] = link
        self._count_change([link.a, link.b])  # a solution under way has the former one in it
        self._due |= {link.a, link.b}
        self._ask_due(now)
        return True

    def connect_later(self, link: Link, now: FrameStamp) -> AtlasReport | None:
        """Take a connection in as soon as the atlas has been solved with it; not while it `is_solving`.

        Returns AtlasReport or None: as for `connect`. None: `collect` will return it.
        """
        if not self._are_connected({link.a, link.b}):
            return self.connect([link], now)
        return self._ask({link.a, link.b}, [link], now)

    def _are_connected(self, submap_ids: set[int]) -> bool:
        return any(submap_ids <= set(component) for component in self._atlas.components())

    def _connect_sets(self, link: Link, now: FrameStamp) -> AtlasReport:
        touched = {link.a, link.b}
        if not (busy := self.is_solving or self.foreseeing):
            self._problems.foresee(touched, [link])
            busy = self.foreseeing
        if busy:
            self._count_change(self._join(link))
            self._due |= touched
            return AtlasReport()
        report = self._ask(touched, [link], now)
        if report is None:
            self._join(link)
            assert self._asked is not None
            self._asked.take_in(len(self._atlas.links) - 1)
        return AtlasReport() if report is None else report

    @property
    def is_solving(self) -> bool:
        """Whether a solution is still to come, or a part of what it moves still to be moved."""
        return self._asked is not None or self._mover.is_moving

    def collect(self, now: FrameStamp) -> AtlasReport | None:
        """Take in what has been solved meanwhile, and go on moving; return the report on connections that have waited
        for it.
        """
        self._mover.step()
        for ended in self._desk.poll(JobKind.ATLAS):
            return self._take(ended.result, now, late=True)
        self._ask_due(now)
        return None

    def _ask_due(self, now: FrameStamp) -> None:
        """Have solved what is due, once it has been computed what that needs."""
        if not self._due or self.is_solving or self.foreseeing:
            return
        if not self._is_due_foreseen:
            self._problems.foresee(self._due, ())
            self._is_due_foreseen = True
        if not self.foreseeing:
            touched, self._due, self._is_due_foreseen = self._due, set(), False
            self._ask(touched, (), now)

    def finish(self, now: FrameStamp) -> AtlasReport | None:
        """Wait, for a limited time, for what is being solved; from now on all is solved at once. See `collect`."""
        self._is_over = True
        self._mover.complete()
        report = None
        for ended in self._desk.drain(JobKind.ATLAS):
            report = self._take(ended.result, now, late=False)
        if self._due:
            self._solve(self._due, (), now)
        self._due = set()
        return report

    def foresee(self, link: Link) -> None:
        """Compute in the background what the solution with a connection to come needs of the submaps."""
        self._problems.foresee({link.a, link.b}, [link])

    @property
    def foreseeing(self) -> bool:
        """Whether that is still being computed."""
        return self._problems.foreseeing

    def follow(self, before: Submap, after: Submap, now: FrameStamp) -> None:
        """Let all that is known against a submap follow a change that its own graph has made.

        Frames, culled keyframes and links go along; where the submap lies on a cycle the atlas is solved again.

        - `before`, `after`: two states of it; `after` is the one in the atlas.
        - `now`: for the event log.
        """
        self.carry(before, after)
        if after.id in self._atlas.placement:
            self._due.add(after.id)
            self._ask_due(now)

    def carry(self, before: Submap, after: Submap) -> None:
        """As `follow`, without solving the atlas again: `settle` comes later."""
        self._count_change([after.id])
        self._mover.leave(after.id)  # it is solved again
        for pose in propagate_poses(self._record.poses.values(), before, after):
            self._record.poses[pose.index] = pose
        propagate_anchors(before, after)
        propagate_links(self._atlas, before, after)
        if held := self._atlas.held.get(after.id):
            self._atlas.held[after.id] = frozenset(k for k in held if k in after.relative_poses)
            if not self._atlas.held[after.id]:  # another camera forgets them all: its graph has taken the bend out
                self._atlas.warps.pop(after.id, None)

    def settle(self, now: FrameStamp) -> None:
        """Solve all sets with cycles once more, here and now, as their submaps are by then."""
        for component in self._atlas.components():
            if component[0] in self._atlas.placement:
                self._solve(set(component), (), now)

    # --- solving

    def _ask(self, touched: set[int], new: Sequence[Link], now: FrameStamp, tries: int = 0) -> AtlasReport | None:
        """Have what is touched solved; return None where that is not done at once."""
        if self._is_over or tries >= MAX_TRIES:
            return self._solve(touched, new, now)
        try:
            skeletons = self._problems.foreseen(touched, new, again=tries > 0)
        except SolverError as error:
            return _failed(str(error))
        self._asked = AskedSolution.of(self._atlas, touched, skeletons, list(new), self._changes, tries)
        self._desk.submit(JobKind.ATLAS, self._asked.problems)
        for ended in self._desk.poll(JobKind.ATLAS):
            return self._take(ended.result, now, late=False)
        return None

    def _take(self, result: tuple[AtlasSolution, ...] | Failure, now: FrameStamp, late: bool) -> AtlasReport | None:
        """Move what a solution moves, if it still holds; else ask again."""
        asked, self._asked = self._asked, None
        assert asked is not None, "there is one question at a time"
        new = asked.links_now(self._atlas)
        if isinstance(result, Failure) and result.reason is FailureReason.SOLVER:
            report = _failed(result.detail)
        elif isinstance(result, Failure) or not asked.holds(self._atlas, self._changes):
            why = result.detail if isinstance(result, Failure) else "the map has changed meanwhile"
            log.info("the atlas is solved again: %s", why)
            again = self._ask(asked.touched, new, now, asked.tries + 1)
            return again if new else None
        else:
            skeletons = asked.skeletons_now(self._atlas, new)
            report = self._move(skeletons, result, new, now, time.perf_counter() - asked.started_s, late)
        return report if new else None

    def _solve(self, touched: set[int], new: Sequence[Link], now: FrameStamp) -> AtlasReport:
        """Solve what is touched here and now."""
        started = time.perf_counter()
        try:
            skeletons = self._problems.now(touched, new)
            solutions = [self._solver.solve(skeleton.problem) for skeleton in skeletons]
        except SolverError as error:
            return _failed(str(error))
        return self._move(skeletons, solutions, new, now, time.perf_counter() - started)

    def _move(
        self,
        skeletons: Sequence[Skeleton],
        solutions: Sequence[AtlasSolution],
        new: Sequence[Link],
        now: FrameStamp,
        seconds: float,
        late: bool = False,
    ) -> AtlasReport:
        """Take connections in, and move what solutions move; `late`: one submap after the other."""
        solved = [Solved.of(*each, new) for each in zip(skeletons, solutions, strict=True)]
        self._atlas.links.extend(new)
        report = replace(together([self._apply(s, late) for s in solved]), seconds=seconds)
        tell(self._record, report, solved, now)
        return report

    def _join(self, link: Link) -> list[int]:
        """Join two sets by the only connection between them; return the second, which moves into the first's world."""
        atlas = self._atlas
        second = max(component for component in atlas.components() if link.a in component or link.b in component)
        for m in second:
            atlas.placement.pop(m, None)
        atlas.link(link)
        return second

    def _count_change(self, submap_ids: Iterable[int]) -> None:
        for m in submap_ids:
            self._changes[m] = self._changes.get(m, 0) + 1

    # --- the transaction

    def _apply(self, solved: Solved, late: bool) -> AtlasReport:
        """Move all that a solution moves. Whatever can fail has been done before."""
        atlas, skeleton = self._atlas, solved.skeleton
        self._count_change(skeleton.component)
        if solved.moves is not None:
            for m in skeleton.component:
                atlas.placement.pop(m, None)
            atlas.placement |= {move.submap_id: move.S_world_submap for move in solved.moves}
        believed = dict(zip(map(id, skeleton.links), solved.believed, strict=True))
        changed: dict[bool, list[int]] = {True: [], False: []}
        for i, link in enumerate(atlas.links):
            if id(link) in believed and (kept := believed[id(link)]) == link.rejected:
                atlas.links[i] = replace(link, rejected=not kept)
                changed[kept].append(i)
        if late:
            self._mover.begin(solved.bends)
        else:
            self._mover.make(solved.bends)
        return solved.report(atlas.links, changed[True], changed[False])


def _failed(detail: str) -> AtlasReport:
    log.warning("the atlas stays as it is: %s", detail)
    return AtlasReport(failure=Failure(FailureReason.SOLVER, detail))
