"""A solution of the atlas that is requested between two frames, and applied to a map that has grown when it comes.

The request is the problem of a linked set (arrays, a megabyte at 600 nodes); the result is where its nodes stand. The
moves that follow act on the submaps from the left, place by place: what their graphs have found meanwhile is kept, and
what has come since goes with the place that it came next to. A solution is void, and requested again, if its problem is
outdated. That is so if something other than its graph changed a submap (a camera, reverse tracking, another solution),
or if a node is gone. It is also so if two nodes moved so far against each other that their covariance no longer holds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from dualslam.atlas.atlas import Atlas, Link
from dualslam.atlas.edge_covariances import answer_edges, much_alike
from dualslam.atlas.propagation import follow_keyframes
from dualslam.atlas.skeleton import Skeleton
from dualslam.core.atlas_problem import AtlasProblem, AtlasSolution, AtlasSolver
from dualslam.core.errors import SolverError
from dualslam.core.geometry import se3
from dualslam.core.jobs import Handlers, JobKind
from dualslam.core.types import Failure, FailureReason, FloatArray
from dualslam.map.submap import Submap


@dataclass(frozen=True, slots=True, eq=False)
class AtlasQuestion:
    """The problems of linked sets that are to be solved: arrays, which nobody changes."""

    problems: tuple[AtlasProblem, ...]


def answer_atlas(
    question: AtlasQuestion, solve: Callable[[AtlasProblem], AtlasSolution]
) -> tuple[AtlasSolution, ...] | Failure:
    """Solve what a question asks for: a background job."""
    try:
        return tuple(solve(problem) for problem in question.problems)
    except SolverError as error:
        return Failure(FailureReason.SOLVER, str(error))


def atlas_handlers(solver: AtlasSolver) -> Handlers:
    """Return what solves the atlas, and gives the covariances that this needs."""
    return {
        JobKind.EDGES: lambda question: answer_edges(question, solver.edge_covariances),
        JobKind.ATLAS: lambda question: answer_atlas(question, solver.solve),
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

    def question(self) -> AtlasQuestion:
        """Return the job."""
        return AtlasQuestion(tuple(skeleton.problem for skeleton in self.skeletons))

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
    T_a, T_b = (atlas.submaps[m].resolve_anchor(k, np.eye(4)) for m, k in zip((link.a, link.b), ends, strict=True))
    return T_a, T_b


def _followed(link: Link, then: tuple[FloatArray, FloatArray], now: tuple[FloatArray, FloatArray]) -> Link:
    if all(np.array_equal(a, b) for a, b in zip(then, now, strict=True)):
        return link
    S_a_b, covariance = follow_keyframes(link.S_a_b, link.covariance, then, now)
    return replace(link, S_a_b=S_a_b, covariance=covariance)
