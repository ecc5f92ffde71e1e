"""Which part of a graph's estimate is read after an update and judged by what, and the landmarks beside the graph."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from dualslam.backend.factor_index import FactorIndex
from dualslam.backend.observability import numbered, take_mask
from dualslam.backend.point_refinement import triangulation_covariances
from dualslam.core.geometry import so3
from dualslam.core.types import BoolArray, FloatArray, IntArray
from dualslam.map.submap import Submap
from dualslam.map.tables import Table

READ_WINDOW = 20
"""Keyframes (the last inserted ones, and their landmarks) whose estimate is read after each update."""
READ_ALL = 0


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A part of a submap's graph."""

    # Keyframe and landmark of each observation row that the graph has looked at.
    kf: IntArray  # (R,)
    lm: IntArray  # (R,)
    inside: IntArray  # (I,): rows that are admitted and alive
    row: IntArray  # (N,): those of them by which the part is judged
    # Ids of the variables to be read.
    keyframes: IntArray
    landmarks: IntArray
    in_graph: BoolArray  # (L,): which landmarks are variables at all
    is_whole: bool  # everything in the graph is read


def choose_part(submap: Submap, index: FactorIndex, entering: IntArray, window: int, everything: bool) -> Part:
    """Return the last `window` keyframes, those just added to, and what they see; with `READ_ALL` the whole graph.

    `everything`: all variables are read, though only the observations of that window are judged.
    """
    obs, rows = submap.observations, index.rows
    kf, lm = obs["kf"][: len(rows)], obs["landmark"][: len(rows)]
    # Rows of keyframes that were culled since the last plan are dead, but not out yet.
    inside = np.flatnonzero(rows["admitted"] & obs["alive"][: len(rows)])
    in_graph = take_mask(lm[rows["factor"] >= 0], len(submap.landmarks))
    keyframes, row = np.array(sorted(index.keyframes), np.int64), inside
    if window and len(keyframes) > window:
        recent = np.union1d(np.array(list(submap.keyframes)[-window:], np.int64), kf[entering])
        row = inside[take_mask(recent, int(max(kf.max(initial=0), recent.max())) + 1)[kf[inside]]]
        keyframes = keyframes if everything else recent
    else:
        everything = True
    seen = take_mask(lm[inside if everything else row], len(submap.landmarks))
    if everything:
        seen |= in_graph
    return Part(kf, lm, inside, row, keyframes, np.flatnonzero(seen & in_graph), in_graph, everything)


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Views of points: rows, the poses of their keyframes, and which of the poses and points each is of."""

    row: IntArray
    T_submap_kf: FloatArray
    pose: IntArray
    point: IntArray


def landmarks_beside(submap: Submap, inside: IntArray, in_graph: BoolArray, newest: list[int] | None) -> IntArray:
    """Return the landmarks of the rows `inside` that are no variables: those that keyframes see, or all (None)."""
    kf, lm = submap.observations["kf"][inside], submap.observations["landmark"][inside]
    if newest is not None:
        lm = lm[np.isin(kf, newest)]
    return np.flatnonzero(take_mask(lm, len(in_graph)) & ~in_graph)


def views_of(submap: Submap, ids: IntArray, inside: IntArray, poses: Mapping[int, FloatArray]) -> Views:
    """Return the views of landmarks among the rows `inside`; `poses` go before those of the submap."""
    obs = submap.observations
    row = inside[take_mask(ids, len(submap.landmarks))[obs["landmark"][inside]]]
    row = row[obs["alive"][row]]
    keyframes, pose = numbered(obs["kf"][row])
    T = [poses[k] if k in poses else submap.T_submap_kf[k] for k in keyframes.tolist()]
    return Views(row, np.array(T).reshape(-1, 4, 4), pose, np.searchsorted(ids, obs["landmark"][row]))


def triangulated_covariances(
    submap: Submap, landmark_ids: IntArray, rows: Table, pose_covariance: Callable[[int], FloatArray]
) -> FloatArray:
    """Return (L, 3, 3) covariances of landmarks beside a graph, in the submap's frame; NaN for those that are not.

    Of the views of a point, the poses held, and of the pose of the newest of them, with which the point moves.

    - `landmark_ids` (L,).
    - `rows`: `FactorIndex.rows`.
    - `pose_covariance`: of a keyframe.
    """
    ids = np.asarray(landmark_ids, np.int64)
    covariances = np.full((len(ids), 3, 3), np.nan)
    inside, factors = np.flatnonzero(rows["admitted"]), np.flatnonzero(rows["factor"] >= 0)
    in_graph = take_mask(submap.observations["landmark"][factors], len(submap.landmarks))
    wanted = np.intersect1d(ids, landmarks_beside(submap, inside, in_graph, None))
    if len(wanted) == 0:
        return covariances
    views, xyz = views_of(submap, wanted, inside, {}), submap.landmarks["xyz_mu"][wanted]
    sigma = rows["sigma_px"][views.row]
    found = triangulation_covariances(submap.K, views.T_submap_kf, views.pose, xyz, views.point, sigma)
    found += _newest_pose_covariances(submap, views, xyz, pose_covariance)
    place = np.searchsorted(wanted, ids).clip(max=len(wanted) - 1)
    mine = wanted[place] == ids
    covariances[mine] = found[place[mine]]
    return covariances


def _newest_pose_covariances(
    submap: Submap, views: Views, xyz: FloatArray, pose_covariance: Callable[[int], FloatArray]
) -> FloatArray:
    """Return (N, 3, 3): what each point moves by with the pose of the newest keyframe that sees it."""
    covariances = np.zeros((len(xyz), 3, 3))
    newest = np.full(len(xyz), -1)
    np.maximum.at(newest, views.point, submap.observations["kf"][views.row])
    for k in np.unique(newest).tolist():
        T, P, of = submap.T_submap_kf[k], pose_covariance(k), np.flatnonzero(newest == k)
        arm = (xyz[of] - T[:3, 3]) @ T[:3, :3]
        J = np.concatenate((-so3.hat(arm), np.broadcast_to(np.eye(3), (len(of), 3, 3))), axis=2)
        J = T[:3, :3] @ J
        covariances[of] = J @ P @ J.transpose(0, 2, 1)
    return covariances
