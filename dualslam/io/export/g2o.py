"""The pose graph of the keyframes as a g2o file, which GTSAM, g2o and Ceres read.

Vertices are keyframes, edges join those that see `MIN_SHARED` landmarks in common, and each keyframe with the next.
What an edge says is where the map has them, and its information grows with the landmarks in common: the map is the
optimum. The observations themselves, which are more than a pose graph, are in BAL's format.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dualslam.atlas.node_views import MIN_SHARED
from dualslam.core.geometry import se3, so3
from dualslam.core.types import FloatArray
from dualslam.io.atomic import write_text
from dualslam.io.export.decimals import decimals
from dualslam.io.export.exported_map import ExportedMap


def write_g2o(exported: ExportedMap, out: Path) -> None:
    """Write one file; a vertex has the number of its keyframe."""
    frames = exported.frame.tolist()
    lines = [f"VERTEX_SE3:QUAT {k} {_pose(T)}" for k, T in zip(frames, exported.T_world_cam, strict=True)]
    for a, b, n in edges(exported):
        T_a_b = se3.inverse(exported.T_world_cam[a]) @ exported.T_world_cam[b]
        information = np.diag([float(max(n, 1))] * 6)[np.triu_indices(6)]
        lines.append(f"EDGE_SE3:QUAT {frames[a]} {frames[b]} {_pose(T_a_b)} " + " ".join(f"{x:g}" for x in information))
    write_text(out, "\n".join(lines) + "\n")


def edges(exported: ExportedMap) -> list[tuple[int, int, int]]:
    """Return pairs of views (rows, a < b) with the number of points that both see."""
    n = len(exported.frame)
    shared = np.zeros((n, n), np.int64)
    first = np.searchsorted(exported.point, np.arange(len(exported.xyz) + 1))
    for start, end in zip(first[:-1].tolist(), first[1:].tolist(), strict=True):
        views = exported.view[start:end]
        shared[np.ix_(views, views)] += 1
    joined = np.triu(shared >= MIN_SHARED, 1)
    joined[np.arange(n - 1), np.arange(1, n)] = True
    return [(int(a), int(b), int(shared[a, b])) for a, b in zip(*np.nonzero(joined), strict=True)]


def _pose(T: FloatArray) -> str:
    quat = so3.quat_xyzw_from_matrix(T[:3, :3])
    return decimals((*T[:3, 3], *quat))
