"""A submap's graph in a process of its own: the tracking solves a window meanwhile, and takes the whole when it comes.

`BesideGraph` is the `SubmapGraph` that the tracking sees. Its updates adjust the newest keyframes (`WindowSolver`).
Between two frames `BesideGraphs` sends the changes of the arrays (`dualslam/map/submap_delta.py`) to the process, one
job at a time. It puts the result into the current submap: known keyframes and landmarks take their values, and newer
ones follow. A process that dies costs its graph: the next job brings the whole submap to a fresh one. A graph that
fails leaves the submap to its window, and is made anew with the next keyframe.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np

from dualslam.core.errors import SolverError
from dualslam.core.estimates import GraphEstimate
from dualslam.core.interfaces import N_WINDOW, SubmapGraph, WindowSolver
from dualslam.core.jobs import Desk, JobKind
from dualslam.core.types import Failure, FailureReason, FloatArray, IntArray
from dualslam.map.submap import Submap
from dualslam.map.submap_change import apply_late
from dualslam.map.submap_delta import SubmapDelta, SubmapMirror, drop_dead_rows

log = logging.getLogger(__name__)

MAX_GRAPHS = 3
"""Graphs that a process keeps: the live one, and those that a merge or a revisited map may still ask for."""


@dataclass(frozen=True, slots=True, eq=False)
class GraphJob:
    """Job of a graph in another process. It can be pickled."""

    graph_id: int
    delta: SubmapDelta
    rebuild: bool  # whether the graph is to be made anew, by a batch solution
    near_optimum: bool  # see `SubmapGraph.rebuild`


class GraphServer:
    """Keeps graphs and the replicas of their submaps, in the process that solves them."""

    def __init__(self, new_graph: Callable[[], SubmapGraph]) -> None:
        self._new_graph = new_graph
        self._graphs: dict[int, tuple[Submap, SubmapGraph]] = {}

    def forget(self) -> None:
        """Forget all graphs, as if the process had been started anew."""
        self._graphs = {}

    def __call__(self, job: GraphJob) -> GraphEstimate | Failure:
        """Do a job, and return the estimate of all that is in the graph.

        A failure forgets the graph, and the next job must bring the whole submap.
        """
        known = self._graphs.pop(job.graph_id, None)
        if known is None and not job.delta.is_whole:
            return Failure(FailureReason.DISABLED, f"graph {job.graph_id} is not known here")
        replica = job.delta.apply(None if known is None else known[0])
        graph = self._new_graph() if known is None or job.delta.is_whole else known[1]
        if job.delta.kept_rows is not None:
            graph.keep_rows(job.delta.kept_rows)
        try:
            solved = graph.rebuild(replica, job.near_optimum) if job.rebuild else graph.update(replica)
            whole = graph.full_estimate(replica)
        except SolverError as error:
            return Failure(FailureReason.SOLVER, str(error))
        replica.apply_estimate(*whole.values)
        self._graphs[job.graph_id] = replica, graph
        while len(self._graphs) > MAX_GRAPHS:
            del self._graphs[next(iter(self._graphs))]
        outliers = np.union1d(solved.outlier_rows, whole.outlier_rows)
        ids, T, landmarks, xyz = whole.values
        return replace(
            solved, keyframe_ids=ids, T_submap_kf=T, landmark_ids=landmarks, xyz_mu=xyz, outlier_rows=outliers
        )


class BesideGraph:
    """The `SubmapGraph` of the tracking, whose solutions come from a window first and from beside later.

    - `window`: adjusts the newest keyframes of a submap.
    - `register`: called with the submap, whenever there is something to send.
    - `in_real_time`: whether frames come by a clock.
    - `open_graph`: makes a graph of a submap in this process, solved.
    """

    def __init__(
        self,
        graph_id: int,
        window: Callable[[Submap], GraphEstimate | Failure],
        register: Callable[[Submap, BesideGraph], None],
        in_real_time: Callable[[], bool],
        open_graph: Callable[[Submap], SubmapGraph],
    ) -> None:
        self.id = graph_id
        self.is_behind = False
        self.holds_refused = False  # observations that its own answer refused: they go with the next keyframe
        self.rebuild_asked: bool | None = None  # near the optimum, or not
        self.mirror = SubmapMirror()
        self.noise2 = 1.0
        self._window = window
        self._register = register
        self._in_real_time = in_real_time
        self._open_graph = open_graph
        self._submap: Submap | None = None  # the last that it was asked about
        self._opened: SubmapGraph | None = None  # a graph of it in this process

    def update(self, submap: Submap) -> GraphEstimate:
        """Adjust the window; the graph will take in what has changed."""
        self._ask(submap)
        start = time.thread_time()
        estimate = self._window(submap)
        if isinstance(estimate, Failure):  # the graph will tell
            estimate = self.full_estimate(submap)
        return replace(estimate, seconds=time.thread_time() - start)

    def rebuild(self, submap: Submap, near_optimum: bool = False) -> GraphEstimate:
        """Let the graph be made anew; meanwhile the submap stays as it is.

        In real time, one near its optimum and known to the process is only updated: a batch takes as long as ten
        updates.
        """
        if near_optimum and self.mirror.knows_replica and self._in_real_time():
            return self.update(submap)
        self.rebuild_asked = near_optimum
        self.mirror = SubmapMirror()
        self._ask(submap)
        return self.full_estimate(submap)

    def full_estimate(self, submap: Submap) -> GraphEstimate:
        """Return the submap as it stands."""
        ids = np.fromiter(submap.keyframes, np.int64, len(submap.keyframes))
        alive, none = np.flatnonzero(submap.landmarks["alive"]), np.zeros(0, np.int64)
        T, xyz = submap.keyframe_poses(ids), submap.landmarks["xyz_mu"][alive]
        return GraphEstimate(ids, T, alive, xyz, none, float("nan"), self.noise2, rebuilt=False, seconds=0.0)

    def pose_covariance(self, keyframe_id: int) -> FloatArray:
        """Return (6, 6); see `opened`."""
        graph: SubmapGraph = self.opened()
        return graph.pose_covariance(keyframe_id)

    def point_covariances(self, landmark_ids: IntArray) -> FloatArray:
        """Return (L, 3, 3); see `opened`."""
        graph: SubmapGraph = self.opened()
        return graph.point_covariances(landmark_ids)

    @property
    def factor_rows(self) -> IntArray:
        """Rows of the submap's observations that are factors; see `opened`."""
        rows: IntArray = self.opened().factor_rows
        return rows

    @property
    def statistics(self) -> Any:
        """The solver's statistics; see `opened`."""
        return self.opened().statistics

    def bayes_tree(self) -> Any:
        """Return the solver's tree; see `opened`."""
        return self.opened().bayes_tree()

    def opened(self) -> Any:
        """Return a graph of the submap in this process: made in batch, at the first question after a change.

        Raises `SolverError` if there is no submap yet, or it cannot be solved.
        """
        if self._submap is None:
            raise SolverError("the graph is empty: update it with its submap first")
        if self._opened is None:
            self._opened = self._open_graph(self._submap)
        return self._opened

    def rows_out(self, submap: Submap) -> IntArray:
        """Return the rows of dead observations that the process is done with, if it has answered all that was sent."""
        return self.mirror.rows_out(submap)

    def keep_rows(self, rows: IntArray) -> None:
        """Let the process hear with its next job that only these rows have stayed."""
        self.mirror.keep_rows(rows)

    def _ask(self, submap: Submap) -> None:
        self.is_behind, self._submap, self._opened = True, submap, None
        self._register(submap, self)


@dataclass(frozen=True, slots=True, eq=False)
class Moved:
    """A submap that has taken in what its graph found. `before`: a copy of it as it was; `rebuilt`: from scratch."""

    submap: Submap
    before: Submap
    rebuilt: bool


class BesideGraphs:
    """Sends the changes of submaps to the process that has their graphs, and puts the results into the submaps.

    `open_graph`: makes a graph of a submap in this process, solved.

    - `in_real_time`: whether frames come by a clock.
    """

    def __init__(self, desk: Desk, window: WindowSolver, open_graph: Callable[[Submap], SubmapGraph]) -> None:
        self._desk = desk
        self._open_graph = open_graph
        self._window = window
        self._ids = count()
        self._graphs: dict[int, BesideGraph] = {}  # by the submap's id: the one that it has now
        self._under_way: tuple[int, BesideGraph, FloatArray] | None = None  # submap's id, its graph and its intrinsics
        self._answered: dict[int, frozenset[int]] = {}  # by the submap's id: the keyframes that its estimate knows
        self.in_real_time = False

    def new_graph(self) -> SubmapGraph:
        """Make the graph of a submap."""
        return BesideGraph(next(self._ids), self._adjust, self._note, lambda: self.in_real_time, self._open_graph)

    def _adjust(self, submap: Submap) -> GraphEstimate | Failure:
        return self._window(submap, list(submap.keyframes)[: -N_WINDOW - 1 : -1])

    def lag(self, submap: Submap) -> int:
        """Count the keyframes of a submap that no answer of its graph has known yet."""
        return len(submap.keyframes.keys() - self._answered.get(submap.id, submap.keyframes.keys()))

    def collect(self, submaps: Mapping[int, Submap]) -> Iterator[Moved]:
        """Put what has come back into its submap, and send what has changed since, if nothing is under way."""
        for ended in self._desk.poll(JobKind.GRAPH):
            if (moved := self._take(ended.result, submaps)) is not None:
                yield moved
        self._send(submaps)

    def finish(self, submaps: Mapping[int, Submap]) -> Iterator[Moved]:
        """Let all graphs take in what they lack, as long as that ends soon; one that fails is left behind."""
        while True:
            for graph in self._graphs.values():
                graph.is_behind |= graph.holds_refused
            self._send(submaps)
            if self._under_way is None:
                return
            answers = self._desk.drain(JobKind.GRAPH)
            if not answers:  # the desk has lost what it was given
                self._forget()
                return
            for ended in answers:
                if isinstance(ended.result, Failure):
                    log.log(_level(ended.result), "a graph was left behind at the end: %s", ended.result.detail)
                    self._forget()
                    if ended.result.reason not in (FailureReason.DISABLED, FailureReason.SOLVER):
                        return  # the process is lost, or takes too long: no graph is sent after it
                elif (moved := self._take(ended.result, submaps)) is not None:
                    yield moved

    def forget(self, submap_id: int) -> None:
        """Let what a submap's graph is solving, or knows, be of no more use: it was moved by others."""
        self._graphs.pop(submap_id, None)

    def _note(self, submap: Submap, graph: BesideGraph) -> None:
        self._graphs[submap.id] = graph
        self._answered.setdefault(submap.id, frozenset(submap.keyframes))

    def _send(self, submaps: Mapping[int, Submap]) -> None:
        if self._under_way is not None:
            return
        # The newest submap first: it is the live one.
        waiting = [m for m, graph in self._graphs.items() if graph.is_behind and m in submaps]
        if not waiting:
            return
        submap, graph = submaps[max(waiting)], self._graphs[max(waiting)]
        near, graph.rebuild_asked = graph.rebuild_asked, None
        graph.is_behind = graph.holds_refused = False
        drop_dead_rows(submap, graph)  # only now: an answer that is under way names rows as they were when it was sent
        self._under_way = submap.id, graph, submap.K
        self._desk.submit(JobKind.GRAPH, GraphJob(graph.id, graph.mirror.delta(submap), near is not None, bool(near)))

    def _take(self, result: GraphEstimate | Failure, submaps: Mapping[int, Submap]) -> Moved | None:
        assert self._under_way is not None
        submap_id, graph, K = self._under_way
        if isinstance(result, Failure):
            log.log(_level(result), "graph of submap %d: %s; it is made anew", submap_id, result.detail)
            self._forget()
            # A solver that has failed on these arrays would fail again: it waits for the next keyframe.
            graph.is_behind = graph.is_behind or result.reason is not FailureReason.SOLVER
            return None
        self._under_way = None
        if self._graphs.get(submap_id) is not graph or graph.rebuild_asked is not None:
            return None  # the submap has another graph by now, or is to be made anew from what it has become
        submap = submaps[submap_id]
        if (submap.K != K).any():  # its camera was changed meanwhile, with one that it is to be linked with
            graph.is_behind = True
            return None
        graph.noise2 = result.noise2
        self._answered[submap_id] = frozenset(result.keyframe_ids.tolist())
        before = apply_late(submap, *result.values)
        rows = result.outlier_rows[submap.observations["alive"][result.outlier_rows]]
        submap.remove_outliers(rows)
        graph.holds_refused = len(rows) > 0
        return Moved(submap, before, result.rebuilt)

    def _forget(self) -> None:
        """Give up what is under way: the process has that graph no more, and the next job makes it anew."""
        assert self._under_way is not None
        (_, graph, _), self._under_way = self._under_way, None
        graph.mirror, graph.rebuild_asked = SubmapMirror(), False


def _level(failure: Failure) -> int:
    """Return the log level of a failure: that the process has let an old map's graph go is no trouble."""
    return logging.INFO if failure.reason is FailureReason.DISABLED else logging.WARNING
