"""A linked set of submaps as a `MetricProblem`, and its frames in the frame of the measurements."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from dualslam.atlas.atlas import Atlas, Link
from dualslam.atlas.edge_covariances import Covariances
from dualslam.atlas.node_views import NodeViews
from dualslam.atlas.skeleton import Skeleton, build_skeleton
from dualslam.atlas.trajectory import FramePose, compose
from dualslam.atlas.warp import Warp
from dualslam.core.atlas_problem import AtlasEdges, AtlasSolver
from dualslam.core.geometry import se3, sim3
from dualslam.core.metric_problem import MetricProblem, MetricSolution, pose_by_node
from dualslam.core.trajectory import Trajectory
from dualslam.core.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class MetricMap:
    """A linked set as a problem, and how its solution comes back to frames and links."""

    problem: MetricProblem
    skeleton: Skeleton
    frames: Trajectory  # in the world, by the frames' numbers
    # Of each frame of `frames`.
    submap: IntArray  # (F,)
    node: IntArray  # (F,)

    @classmethod
    def of(
        cls, atlas: Atlas, poses: Iterable[FramePose], component: list[int], covariances: Covariances
    ) -> MetricMap | None:
        """Make the problem of a linked set; None where it has fewer than two frames.

        Raises `SolverError` if a submap cannot tell its covariances.
        """
        of_submap = {p.index: p.submap_id for p in poses if p.submap_id in component}
        S_world = atlas.S_world_submap(component)
        frames = compose(poses, atlas, S_world)
        if len(frames) < 2:
            return None
        links = [link for link in atlas.believed if link.a in component and link.b in component]
        skeleton = build_skeleton(
            atlas, component, links, covariances, NodeViews(), lambda link: True, with_covariances=True
        )
        S = np.empty((len(skeleton.nodes), 4, 4))
        submap = np.array([of_submap[i] for i in frames.index.tolist()], np.int64)
        node = np.empty(len(frames), np.int64)
        for m in component:
            rows, knots = skeleton.knots(m)
            S[rows] = S_world[m] @ skeleton.T_submap_node[rows]
            here = submap == m
            apart = np.abs(frames.index[here][:, None] - np.array(knots))
            node[here] = np.array(rows)[apart.argmin(axis=1)]
        order = frames.timestamps_s.argsort(kind="stable")
        edges = skeleton.problem.edges
        assert isinstance(edges, AtlasEdges)
        problem = MetricProblem(S, edges, frames.timestamps_s[order], frames.T_world_cam[order], node[order])
        return cls(problem, skeleton, frames, submap, node)

    def placed(self, solution: MetricSolution) -> Trajectory:
        """Return the frames in the frame of the measurements, metres; between nodes the correction is interpolated."""
        S_metric_world = solution.S_metric_node @ sim3.inverse(self.problem.S_world_node)
        T = np.empty_like(self.frames.T_world_cam)
        for m in self.skeleton.component:
            rows, knots = self.skeleton.knots(m)
            here = self.submap == m
            if here.any():
                S = Warp(np.array(knots), S_metric_world[rows]).at(self.frames.index[here])
                T[here] = sim3.act_on_pose(S, self.frames.T_world_cam[here])
        return Trajectory(self.frames.timestamps_s, T, self.frames.index)

    def relative_covariances(self, solver: AtlasSolver) -> FloatArray:
        """Return (F, 6, 6) of the frames relative to the node of the first one, whose scale holds the unit.

        Raises `SolverError`.
        """
        of_node = solver.relative_covariances(self.skeleton.problem, int(self.problem.node[0]))
        return self.covariances(self.problem.S_world_node, of_node)

    def covariances(self, S_frame_node: FloatArray, of_node: FloatArray) -> FloatArray:
        """Return (F, 6, 6) of the frames: right perturbation, rotation (rad), then translation (unit of the frame).

        Variances grow linearly from one node to the next, as those of a random walk do.

        - `S_frame_node`, `of_node` (N, 4, 4), (N, 7, 7): the nodes in a common frame, and their covariances.
        """
        C = np.empty((len(self.frames), se3.DOF, se3.DOF))

        def beside(frame: IntArray, node: IntArray) -> FloatArray:
            S_node_world = sim3.inverse(self.problem.S_world_node[node])
            T_node_cam = sim3.act_on_pose(S_node_world, self.frames.T_world_cam[frame])
            scale = sim3.scale(S_frame_node[node]).tolist()
            J = np.array([pose_by_node(s, T) for s, T in zip(scale, T_node_cam, strict=True)]).reshape(
                -1, se3.DOF, sim3.DOF
            )
            return np.asarray(J @ of_node[node] @ J.swapaxes(1, 2))

        for m in self.skeleton.component:
            rows, knots = (np.array(each) for each in self.skeleton.knots(m))
            here = np.flatnonzero(self.submap == m)
            place = np.interp(self.frames.index[here], knots, np.arange(len(knots)))
            before = place.astype(int)
            after, share = np.minimum(before + 1, len(knots) - 1), (place - before)[:, None, None]
            C[here] = (1 - share) * beside(here, rows[before]) + share * beside(here, rows[after])
        return C

    def refuted(self, solution: MetricSolution) -> list[Link]:
        """Return the links that the measurements contradict."""
        n = len(self.skeleton.links)
        believed = solution.believed[len(solution.believed) - n :] if n else solution.believed[:0]
        return [link for link, kept in zip(self.skeleton.links, believed.tolist(), strict=True) if not kept]
