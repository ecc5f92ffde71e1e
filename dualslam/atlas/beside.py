"""A solution of the atlas that is requested between two frames, and applied to a map that has grown when it comes.

The request is the problem of a linked set (arrays, a megabyte at 600 nodes); the result is where its nodes stand. The
moves that follow act on the submaps from the left, place by place: what their graphs have found meanwhile is kept, and
what has come since goes with the place that it came next to. A solution is void, and requested again, if something
other than its graph changed a submap, or a node is gone. It is also void if two nodes moved so far against each other
that their covariance no longer holds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from dualslam.atlas.atlas import Atlas, Link, joined
from dualslam.atlas.edge_covariances import Covariances, EdgeCovariances, answer_edges, much_alike
from dualslam.atlas.node_views import NodeViews
from dualslam.atlas.propagation import follow_keyframes
from dualslam.atlas.record import Record
from dualslam.atlas.skeleton import Skeleton, build_skeleton, foresee_skeleton, skeleton_knots
from dualslam.core.atlas_problem import AtlasProblem, AtlasSolution, AtlasSolver
from dualslam.core.errors import SolverError
from dualslam.core.geometry import se3
from dualslam.core.jobs import Desk, Handlers, JobKind
from dualslam.core.types import Failure, FailureReason, FloatArray
from dualslam.map.submap import Submap


class AtlasProblems:
    """Makes the problems of the linked sets that connections touch.

    `desk`: where covariances are computed that a problem to come will need.

    - `covariances`: what the submaps say of their own edges.
    - `views`: what their nodes see.
    """

    def __init__(self, record: Record, solver: AtlasSolver, desk: Desk) -> None:
        self._record = record
        self.covariances = EdgeCovariances(solver.edge_covariances, desk)
        self.views = NodeViews()
        self._newest: dict[int, int] = {}  # by submap: its newest keyframe at the last request

    def foresee(self, touched: set[int], new: Sequence[Link]) -> None:
        """Compute in the background what the solution with connections to come needs of the submaps."""
        atlas = self._record.atlas
        for component, links in self._touched(touched, new):
            foresee_skeleton(atlas, component, links, self.covariances, self.views)
        # What has come by the time that they are there goes with the keyframes that were asked about.
        self._newest = {m: max(submap.keyframes) for m, submap in atlas.submaps.items()}

    def foresee_rollover(self, submap_id: int) -> None:
        """Ask a full submap for its covariances now: the first loop of a long run would wait for those of all."""
        atlas = self._record.atlas
        submap = atlas.submaps[submap_id]
        pairs = list(pairwise(skeleton_knots(submap)))
        self.covariances.foresee(submap, pairs, atlas.held.get(submap_id, frozenset()))

    @property
    def foreseeing(self) -> bool:
        """Whether that is still being computed."""
        return self.covariances.foreseeing

    def now(self, touched: set[int], new: Sequence[Link]) -> list[Skeleton]:
        """Make the problems of all linked sets that are touched, as the submaps are now.

        Raises `SolverError` if a submap cannot tell its covariances.
        """
        self._newest = {}
        return self._make(touched, new, self.covariances)

    def foreseen(self, touched: set[int], new: Sequence[Link], again: bool) -> list[Skeleton]:
        """Make them with what was prefetched; `again`: with covariances that hold for the current submaps.

        Raises `SolverError`: as for `now`.
        """
        skeletons = self._make(touched, new, self.covariances if again else self.covariances.as_foreseen)
        self._newest = {}
        return skeletons

    def _make(self, touched: set[int], new: Sequence[Link], covariances: Covariances) -> list[Skeleton]:
        fresh = set(map(id, new))

        def known(link: Link) -> bool:
            return id(link) not in fresh and not link.rejected

        return [
            build_skeleton(self._record.atlas, component, links, covariances, self.views, known, newest=self._newest)
            for component, links in self._touched(touched, new)
        ]

    def _touched(self, touched: set[int], new: Sequence[Link]) -> Iterator[tuple[list[int], list[Link]]]:
        """Give the linked sets that new connections make of what they touch, each with its connections."""
        atlas = self._record.atlas
        links = [*atlas.links, *new]
        for component in joined(atlas.submaps, links):
            if touched & set(component):
                yield component, [link for link in links if link.a in component]


def answer_atlas(
    problems: tuple[AtlasProblem, ...], solve: Callable[[AtlasProblem], AtlasSolution]
) -> tuple[AtlasSolution, ...] | Failure:
    """Solve the problems of linked sets, which nobody changes: a background job."""
    try:
        return tuple(solve(problem) for problem in problems)
    except SolverError as error:
        return Failure(FailureReason.SOLVER, str(error))


def atlas_handlers(solver: AtlasSolver) -> Handlers:
    """Return what solves the atlas, and gives the covariances that this needs."""
    return {
        JobKind.EDGES: lambda question: answer_edges(question, solver.edge_covariances),
        JobKind.ATLAS: lambda problems: answer_atlas(problems, solver.solve),
    }


@dataclass(slots=True, eq=False)
class AskedSolution:
    """A request, and the state of the atlas that it is about."""

    touched: set[int]  # submaps whose linked sets were to be solved
    skeletons: list[Skeleton]
    new: list[Link]  # connections that wait for the solution, in submaps as they were
    rows: list[list[int]]
    """For each skeleton, where the links of the atlas stand in its list that are the first of the skeleton's."""
    changes: dict[int, int]  # by submap, how many times others than its graph had changed it
    ends: list[tuple[int, int]]  # list of (int, int): the two keyframes of each new connection
    T_ends: list[tuple[FloatArray, FloatArray]]  # list of ((4, 4), (4, 4)): their poses
    tries: int = 0  # how many times it was asked before
    started_s: float = field(default_factory=time.perf_counter)

    @classmethod
    def of(
        cls,
        atlas: Atlas,
        touched: set[int],
        skeletons: list[Skeleton],
        new: list[Link],
        changes: Mapping[int, int],
        tries: int,
    ) -> AskedSolution:
        """Note the state of the atlas."""
        row = {id(link): i for i, link in enumerate(atlas.links)}
        ends = [link.attached(atlas) for link in new]
        return cls(
            touched,
            skeletons,
            new,
            [[row[id(link)] for link in skeleton.links if id(link) in row] for skeleton in skeletons],
            {m: changes.get(m, 0) for skeleton in skeletons for m in skeleton.component},
            ends,
            [_poses(atlas, link, at) for link, at in zip(new, ends, strict=True)],
            tries,
        )

    @property
    def problems(self) -> tuple[AtlasProblem, ...]:
        """The job."""
        return tuple(skeleton.problem for skeleton in self.skeletons)

    def take_in(self, row: int) -> None:
        """Note that the connection that waited has been taken into the atlas, as the last."""
        self.new, self.ends, self.T_ends = [], [], []
        self.rows[0].append(row)

    def holds(self, atlas: Atlas, changes: Mapping[int, int]) -> bool:
        """Whether the problem is still the one that there is."""
        if any(changes.get(m, 0) != n for m, n in self.changes.items()):
            return False
        return all(
            _much_as_it_was(atlas.submaps[m], *skeleton.knots(m), skeleton.T_submap_node)
            for skeleton in self.skeletons
            for m in skeleton.component
        )

    def links_now(self, atlas: Atlas) -> list[Link]:
        """Return the new connections between the current submaps: what holds is how two keyframes lie."""
        known = zip(self.new, self.ends, self.T_ends, strict=True)
        return [_followed(link, then, _poses(atlas, link, at)) for link, at, then in known]

    def skeletons_now(self, atlas: Atlas, new: list[Link]) -> list[Skeleton]:
        """Return the skeletons with the current links of the atlas; `new`: see `links_now`."""
        now = dict(zip(map(id, self.new), new, strict=True))
        return [
            replace(
                skeleton,
                links=[
                    *(atlas.links[row] for row in rows),
                    *(now[id(link)] for link in skeleton.links if id(link) in now),
                ],
            )
            for skeleton, rows in zip(self.skeletons, self.rows, strict=True)
        ]


def _much_as_it_was(submap: Submap, rows: list[int], knots: list[int], T_then: FloatArray) -> bool:
    if not submap.keyframes.keys() >= set(knots):
        return False
    then, now = (se3.inverse(T[:-1]) @ T[1:] for T in (T_then[rows], submap.keyframe_poses(knots)))
    return bool(much_alike(then, now).all())


def _poses(atlas: Atlas, link: Link, ends: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return the poses of the keyframes that a link stands between; those that were culled are still known."""
    T_a, T_b = (atlas.submaps[m].resolve_anchor(k, se3.IDENTITY) for m, k in zip((link.a, link.b), ends, strict=True))
    return T_a, T_b


def _followed(link: Link, then: tuple[FloatArray, FloatArray], now: tuple[FloatArray, FloatArray]) -> Link:
    if all(np.array_equal(a, b) for a, b in zip(then, now, strict=True)):
        return link
    S_a_b, covariance = follow_keyframes(link.S_a_b, link.covariance, then, now)
    return replace(link, S_a_b=S_a_b, covariance=covariance)
