"""A submap that has moved from one state to another: what was posed in the old one, or made from it, follows."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.interfaces import SubmapGraph
from dualslam.core.noise_model import GROUP
from dualslam.core.types import FloatArray, IntArray
from dualslam.map.submap import Submap

N_NEAREST = 3
"""Keyframes that a newer one follows: one alone may have been moved by its own noise."""


def change_of_frame(
    before: Submap, after: Submap, keyframe_ids: Iterable[int], n_landmarks: int | None = None
) -> FloatArray:
    """Return ``S_after_before``, which takes the surroundings of some keyframes from one state of a map to the other.

    It holds about `keyframe_ids` alone, as a solved map bends: it turns and shifts as their poses did on average, and
    scales as the median depth of what they see.

    - `before`, `after`: two states of one submap.
    - `keyframe_ids`: at least one of them stands in both.
    - `n_landmarks`: landmarks from this id on are not the same in both states.

    Returns (4, 4) float64.
    """
    shared = [k for k in keyframe_ids if k in before.keyframes and k in after.keyframes]
    if not shared:
        raise ValueError(f"submap {before.id}: none of the keyframes stands in both states")
    T_before, T_after = before.keyframe_poses(shared), after.keyframe_poses(shared)
    R = so3.orthonormalise((se3.rotation(T_after) @ se3.rotation(T_before).transpose(0, 2, 1)).sum(0))
    n = min(len(before.landmarks), len(after.landmarks), len(before.landmarks) if n_landmarks is None else n_landmarks)
    ratios = [_depth_ratios(before, after, k, n) for k in shared]
    together = np.concatenate(ratios)
    scale = float(np.median(together)) if len(together) else 1.0
    t = (se3.translation(T_after) - scale * se3.translation(T_before) @ R.T).mean(0)
    return sim3.from_parts(scale, R, t)


def _depth_ratios(before: Submap, after: Submap, k: int, n: int) -> FloatArray:
    """Depth after over depth before, of the landmarks that a keyframe sees."""
    ids = before.landmark_of[k]
    ids = ids[(ids >= 0) & (ids < n)]
    ids = ids[before.landmarks["alive"][ids] & after.landmarks["alive"][ids]]
    depths = [submap.depths(ids, se3.inverse(submap.T_submap_kf[k])) for submap in (before, after)]
    in_front = (depths[0] > 0) & (depths[1] > 0)
    return np.asarray(depths[1][in_front] / depths[0][in_front], np.float64)


def apply_late(
    submap: Submap,
    keyframe_ids: IntArray,
    T_submap_kf: FloatArray,
    landmark_ids: IntArray,
    xyz_mu: FloatArray,
) -> Submap:
    """Apply an estimate that was made from an earlier state of a submap; return a copy of the submap as it was.

    What has come since follows what stands next to it: keyframes their nearest ones in time, landmarks the keyframe
    that described them first. These are initial values for the next solution.

    `keyframe_ids`, `T_submap_kf`, `landmark_ids`, `xyz_mu`: as for `Submap.apply_estimate`; in the frame and about the
    unit of the submap.
    """
    before = submap.copy()
    known = np.array([k for k in keyframe_ids.tolist() if k in submap.keyframes], np.int64)
    submap.apply_estimate(keyframe_ids, T_submap_kf, landmark_ids, xyz_mu)
    if not len(known):
        return before
    estimated = set(known.tolist())
    newer = [k for k in submap.keyframes if k not in estimated]
    changes = {k: change_of_frame(before, submap, _nearest(known, k)) for k in newer}
    for k, S in changes.items():
        submap.T_submap_kf[k] = sim3.act_on_pose(S, before.T_submap_kf[k])
    _move_points(submap, before, known, landmark_ids)
    return before


def _nearest(known: IntArray, k: int) -> list[int]:
    return [int(near) for near in known[np.argsort(np.abs(known - k), kind="stable")[:N_NEAREST]]]


def _move_points(submap: Submap, before: Submap, known: IntArray, landmark_ids: IntArray) -> None:
    """Let the landmarks that the estimate does not know keep their places relative to a keyframe, in its new unit."""
    lm = submap.landmarks
    rest = lm["alive"].copy()
    rest[landmark_ids] = False
    ids = np.flatnonzero(rest)
    if not len(ids):
        return
    scale = float(sim3.scale(change_of_frame(before, submap, known[-GROUP:].tolist())))
    all_ids = np.array(sorted(submap.keyframes), np.int64)
    place = np.searchsorted(all_ids, lm["first_kf"][ids]).clip(0, len(all_ids) - 1)
    S_cam = np.diag([scale, scale, scale, 1.0])
    moves = submap.keyframe_poses(all_ids) @ S_cam @ se3.inverse(before.keyframe_poses(all_ids))
    of_each = moves[place]
    xyz = before.landmarks["xyz_mu"][ids]
    lm["xyz_mu"][ids] = np.einsum("nij,nj->ni", se3.rotation(of_each), xyz) + se3.translation(of_each)
    lm["distance_mu"][ids] *= scale


def open_graph(submap: Submap, new_graph: Callable[[], SubmapGraph]) -> SubmapGraph:
    """Return a graph of a submap as it is, solved in batch, from which covariances can be asked.

    The submap stays as it is.

    Raises `SolverError`.
    """
    graph = new_graph()
    graph.rebuild(submap.copy(), near_optimum=True)
    return graph


def solve(submap: Submap, graph: SubmapGraph, near_optimum: bool = False) -> int:
    """Solve a submap in a graph made anew, and drop what the solution contradicts; return how many observations.

    `near_optimum`: whether its parts are solved already.

    Raises `SolverError`.
    """
    estimate = graph.rebuild(submap, near_optimum)
    submap.apply_estimate(*estimate.values)
    submap.remove_outliers(estimate.outlier_rows)
    return len(estimate.outlier_rows)
