"""An overlap refined on both of its sides: keyframes and landmarks about a connection, of two submaps or two ends of
one.

What the two maps see there becomes one bundle: the same frame is one camera, landmarks that are the same are one point
with the views of both. The keyframes beyond stay where they are, on either side, so that nothing tears.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualslam.core.bundle import BundleProblem, BundleResult
from dualslam.core.firsts import is_first
from dualslam.core.geometry import sim3
from dualslam.core.types import Failure, FailureReason, FloatArray, IntArray
from dualslam.map.submap import Submap

N_FREE, N_FIXED = 8, 12
"""Keyframes of each side that are refined, and of those beyond that hold them: by what they share with the overlap."""
MIN_JOINED = 10
"""Points that both sides see: fewer say nothing about how they stand to each other."""


@dataclass(frozen=True, slots=True)
class OverlapRefinement:
    """What a refinement did.

    Attributes
    ----------
    n_keyframes, n_landmarks, n_joined, n_observations : int
        Refined keyframes; points, and those of them that both sides see; what was seen.
    cost_before, cost_after : float
        Sum of the robust losses.
    moved : dict of int to float
        By submap: farthest that a keyframe went, in its unit.
    """

    n_keyframes: int
    n_landmarks: int
    n_joined: int
    n_observations: int
    cost_before: float
    cost_after: float
    moved: dict[int, float]


@dataclass(frozen=True, slots=True, eq=False)
class SeamProblem:
    """A bundle in the first submap's frame, and what its rows stand for.

    Attributes
    ----------
    problem : BundleProblem
    keyframe_ids : list of int
    points : list of IntArray
        For each side the row of the point of each landmark, -1 for those that are not in it.
    S_side_first : list of (4, 4)
        From the first submap's frame to each side's.
    n_joined : int
    """

    problem: BundleProblem
    keyframe_ids: list[int]
    points: list[IntArray]
    S_side_first: list[FloatArray]
    n_joined: int


def overlap_problem(
    sides: tuple[Submap, Submap], keyframes: tuple[int, int], S_first_second: FloatArray, landmark_pairs: IntArray
) -> SeamProblem | Failure:
    """Gather what two sides of an overlap see.

    Parameters
    ----------
    sides : (Submap, Submap)
        The same one twice for a loop within a submap.
    keyframes : (int, int)
        About which the overlap lies, on each side.
    S_first_second : (4, 4)
        How they stand to each other by now.
    landmark_pairs : (I, 2) int64
        Landmarks of either side that are the same point.
    """
    first, second = sides
    if not np.array_equal(first.K, second.K):
        return Failure(FailureReason.CAMERA, "the two maps were made with different cameras")
    windows = [_near(submap, k) for submap, k in zip(sides, keyframes, strict=True)]
    free = [set(window[:N_FREE]) for window in windows]
    held = [set(window[N_FREE:]) for window in windows]
    if first is second:
        free = [free[0] | free[1]] * 2
        held = [(held[0] | held[1]) - free[0]] * 2
    S_side_first = [np.eye(4), sim3.inverse(S_first_second)]
    ids = sorted(free[0] | free[1] | held[0] | held[1])
    fixed = np.array([k in held[0] or k in held[1] for k in ids], bool)
    T = np.array(
        [
            first.T_submap_kf[k] if k in free[0] | held[0] else sim3.act_on_pose(S_first_second, second.T_submap_kf[k])
            for k in ids
        ]
    )
    points, xyz, n_joined = _points(sides, free, S_first_second, landmark_pairs)
    if n_joined < MIN_JOINED:
        return Failure(FailureReason.TOO_FEW_MATCHES, f"both sides of the overlap see {n_joined} points")
    rows = [_observations(submap, ids, own) for submap, own in zip(sides, points, strict=True)]
    if first is second:
        rows = rows[:1]
    kf, point, uv, sigma = (np.concatenate(column) for column in zip(*rows, strict=True))
    _, once = np.unique(np.stack((kf, point), 1), axis=0, return_index=True)
    once = np.sort(once)
    problem = BundleProblem(first.K, T, fixed, xyz, kf[once], point[once], uv[once], sigma[once])
    return SeamProblem(problem, ids, points, S_side_first, n_joined)


def apply_overlap(sides: tuple[Submap, Submap], refinement: SeamProblem, result: BundleResult) -> dict[int, float]:
    """Take a solution over on both sides; return how far a keyframe went in each submap, in its unit."""
    moved: dict[int, float] = {}
    for submap, points, S in zip(sides, refinement.points, refinement.S_side_first, strict=True):
        free = [
            (k, T)
            for k, T, held in zip(refinement.keyframe_ids, result.T_submap_kf, refinement.problem.fixed, strict=True)
        ]
        gone = 0.0
        for (k, T), held in zip(free, refinement.problem.fixed.tolist(), strict=True):
            if held or k not in submap.keyframes:
                continue
            T_now = sim3.act_on_pose(S, T)
            gone = max(gone, float(np.linalg.norm(T_now[:3, 3] - submap.T_submap_kf[k][:3, 3])))
            submap.T_submap_kf[k] = T_now
        own = np.flatnonzero(points >= 0)
        own = own[result.adjusted[points[own]]]
        submap.landmarks["xyz_mu"][own] = sim3.act(S, result.xyz_mu[points[own]])
        moved[submap.id] = max(gone, moved.get(submap.id, 0.0))
    return moved


def _near(submap: Submap, keyframe_id: int) -> list[int]:
    """Return a keyframe and those that share most with it, condemned ones left out."""
    ids, _ = submap.covisible(submap.landmarks_of_keyframes([keyframe_id]))
    others = [k for k in ids.tolist() if k != keyframe_id and k not in submap.condemned]
    return [keyframe_id, *others][: N_FREE + N_FIXED]


def _points(
    sides: tuple[Submap, Submap], free: list[set[int]], S_first_second: FloatArray, landmark_pairs: IntArray
) -> tuple[list[IntArray], FloatArray, int]:
    """Return for each side the point of each landmark (-1: none), the points, and how many both sides have."""
    first, second = sides
    seen = [submap.landmarks_of_keyframes(sorted(ids)) for submap, ids in zip(sides, free, strict=True)]
    pairs = landmark_pairs
    if first is not second:
        pairs = np.concatenate((pairs, _same_features(first, second, free[0] & free[1])))
    pairs = np.stack((first.current_ids(pairs[:, 0]), second.current_ids(pairs[:, 1])), 1)
    pairs = pairs[(pairs >= 0).all(1)]
    if first is second:
        pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    of_first = np.full(len(first.landmarks), -1, np.int64)
    chosen = np.union1d(seen[0], pairs[np.isin(pairs[:, 1], seen[1]), 0])
    of_first[chosen] = np.arange(len(chosen))
    xyz = first.landmarks["xyz_mu"][chosen]
    if first is second:
        inside = (of_first[pairs] >= 0).all(1)
        joined = pairs[inside]
        of_first[joined[:, 1]] = of_first[joined[:, 0]]
        return [of_first, of_first], xyz, len(joined)
    of_second = np.full(len(second.landmarks), -1, np.int64)
    joined = pairs[np.isin(pairs[:, 1], seen[1])]
    joined = joined[is_first(joined[:, 0]) & is_first(joined[:, 1])]
    of_second[joined[:, 1]] = of_first[joined[:, 0]]
    alone = seen[1][of_second[seen[1]] < 0]
    of_second[alone] = len(chosen) + np.arange(len(alone))
    xyz = np.concatenate((xyz, sim3.act(S_first_second, second.landmarks["xyz_mu"][alone])))
    return [of_first, of_second], xyz, len(joined)


def _same_features(first: Submap, second: Submap, shared: set[int]) -> IntArray:
    """Return pairs of landmarks that hold the same feature of a keyframe that both maps have."""
    pairs = [np.zeros((0, 2), np.int64)]
    for k in sorted(shared):
        n = first.keyframes[k].features.n_common(second.keyframes[k].features)
        both = np.stack((first.landmark_of[k][:n], second.landmark_of[k][:n]), 1)
        pairs.append(both[(both >= 0).all(1)])
    return np.concatenate(pairs)


def _observations(
    submap: Submap, ids: list[int], points: IntArray
) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    rows = submap.rows_of_landmarks(np.flatnonzero(points >= 0))
    kf = submap.observations["kf"][rows]
    inside = np.isin(kf, ids)
    rows, kf = rows[inside], kf[inside]
    uv, sigma = submap.observed_pixels(rows)
    return np.searchsorted(ids, kf), points[submap.observations["landmark"][rows]], uv, sigma
