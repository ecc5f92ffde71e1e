"""Test for a second pose beyond a gap that explains nearly as much as the first: then the scene repeats itself.

A ratio test removes just the matches that would show a repetition. So every point is paired with all similar features.
The pairs that the first pose explains are removed, and the rest is searched for another pose. (The same test for two
maps: `dualslam/places/sides.py`.)

What a pose explains is counted among the points that it has in view: by number alone a pose near the last one before
the gap, which has nearly all in view, would win.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dualslam.core.arrays import rank_in_runs
from dualslam.core.camera.base import Camera
from dualslam.core.chi_square import CHI2_99, MEDIAN_CHI2
from dualslam.core.geometry.projection import project_points, refine_pose
from dualslam.core.interfaces import Frontend
from dualslam.core.noise_model import MIN_CONSENSUS
from dualslam.core.types import BoolArray, Failure, FailureReason, Features, FloatArray, IntArray, Matches, Track
from dualslam.frontends.features.groups import all_distances, best_per_group, lowest_in_group
from dualslam.frontends.tracking.resection import resect
from dualslam.map.submap import Submap

DOUBTFUL = 0.15
"""Times what the first pose explains of its view, from which on a second makes it doubtful. On real sequences (car,
drone, hand, head) one of 560 pairs of places has more, and nine of ten have no second pose. The right pose of a camera
that has moved on by some periods has 0.2 to 0.7: a wrong one that shows what was seen from the same side finds more."""
N_ALIKE = 16
"""Features that one point is paired with. Fewer than an image has copies of a thing, and another pose seems to explain
too little: on a board of thirty like prints a pose that is a period off lost half of its points with four."""
N_DRAWN = 4
"""Of these, the nearest that RANSAC draws from."""
N_POINTS, N_FEATURES = 300, 1500
"""Of a kind that are compared, all with all, at most (spread over them): half a million pairs are 50 ms."""
N_MODES = 4
"""Shifted poses that are tried."""
HYPOTHESES = 5000
"""Of three points: of four candidates for each point one is right at best, and of many points none."""
SAME_PX = 12.0
"""Median distance in the image, in sigmas of the pixels, up to which two poses show the points at one place: four times
what the gate of a match lets through. Texture alone makes nearer neighbours alike. Where points are uncertain
themselves, as in a map of few keyframes, the sigma is that of the pairs that the first pose explains."""
AGREES = float(np.sqrt(CHI2_99[2]))
"""Sigmas of the pixel within which a pose explains a pair."""


@dataclass(frozen=True, slots=True, eq=False)
class SecondPose:
    """Another pose, and how many points it and the first one explain."""

    T_cam_w: FloatArray  # (4, 4)
    support: int
    first_support: int
    # Points that the poses have in the image.
    in_view: int
    first_in_view: int

    @property
    def makes_doubtful(self) -> bool:
        """Whether it explains nearly as much of its view as the first does."""
        return self.support * self.first_in_view >= DOUBTFUL * self.first_support * self.in_view


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """Points that are known from before a gap, and a frame beyond it."""

    frontend: Frontend  # whose descriptors these are
    descriptors: NDArray[np.generic]  # (N, D): of the points, whether or not they were matched
    xyz: FloatArray  # (N, 3)
    features: Features  # of the frame
    K: FloatArray  # (3, 3)
    camera: Camera  # as it was given: what self-calibration corrects moves the rim of its image by little

    def explained(self, T_cam_w: FloatArray, point: IntArray, feature: IntArray, sigmas: float) -> BoolArray:
        """Return which pairs of a point and a feature lie within so many sigmas of the pixel under a pose."""
        uv, depth = project_points(self.K, T_cam_w, self.xyz[point])
        off_px = np.linalg.norm(uv - self.features.uv_rect_px[feature], axis=1)
        return np.asarray((depth > 0) & (off_px < sigmas * self.features.sigma_px[feature]))

    def n_in_view(self, T_cam_w: FloatArray) -> int:
        """Count the points that a pose has in the image."""
        uv, depth = project_points(self.K, T_cam_w, self.xyz)
        return int(np.count_nonzero((depth > 0) & self.camera.shows(uv)))


def refuse_look_alike(sight: Sight, T_cam_w: FloatArray, seed: int, any_is_doubt: bool = False) -> Failure | None:
    """Return why a pose beyond a gap is not to be believed, if another one explains nearly as much.

    - `T_cam_w` (4, 4): the first pose.
    - `any_is_doubt`: however few points another pose explains, the first is not believed; all points are compared.
    """
    others = find_other_poses(sight, T_cam_w, seed, len(sight.xyz) if any_is_doubt else N_POINTS)
    if not others or not (others[0].makes_doubtful or any_is_doubt):
        return None
    second = others[0]
    numbers = {
        "second_pose": float(second.support),
        "second_in_view": float(second.in_view),
        "first_pose": float(second.first_support),
        "first_in_view": float(second.first_in_view),
    }
    detail = (
        f"another pose explains {second.support} of {second.in_view} points in view,"
        f" this one {second.first_support} of {second.first_in_view}"
    )
    return Failure(FailureReason.LOOK_ALIKE, detail, numbers)


def refuse_second_pose(
    submap: Submap, track: Track, keyframe_ids: Sequence[int], frontend: Frontend, camera: Camera, seed: int
) -> Failure | None:
    """Refuse a track if another pose explains nearly as much of what some keyframes see, by their own descriptors."""
    features, ids, known = [], [], np.zeros(len(submap.landmarks), bool)
    for k in keyframe_ids:
        row = np.flatnonzero(submap.landmark_of[k] >= 0)
        row = row[~known[submap.landmark_of[k][row]]]
        ids.append(submap.landmark_of[k][row])
        features.append(submap.keyframes[k].features.descriptors[row])
        known[ids[-1]] = True
    xyz = submap.landmarks["xyz_mu"][np.concatenate(ids)]
    sight = Sight(frontend, np.concatenate(features), xyz, track.view.features, submap.K, camera)
    return refuse_look_alike(sight, track.T_cam_submap, seed)


def find_other_poses(sight: Sight, T_cam_w: FloatArray, seed: int, n_points: int = N_POINTS) -> list[SecondPose]:
    """Look for other poses among the pairs that the first one leaves over, each of which shows the points elsewhere.

    The one that explains most of its view comes first.
    """
    chosen, seen = _spread(len(sight.xyz), n_points), _spread(len(sight.features), N_FEATURES)
    xyz, features, K = sight.xyz[chosen], sight.features.take(seen), sight.K
    sight = replace(sight, descriptors=sight.descriptors[chosen], xyz=xyz, features=features)
    point, feature, rank = _alike(sight.frontend, sight.descriptors, features.descriptors)
    explained = sight.explained(T_cam_w, point, feature, AGREES)
    first_support, first_in_view = len(np.unique(point[explained])), sight.n_in_view(T_cam_w)
    rest = np.flatnonzero(~explained)
    if len(rest) < MIN_CONSENSUS:
        return []
    of_rest, at_rest = point[rest], feature[rest]
    uv, sigma = features.uv_rect_px[at_rest], features.sigma_px[at_rest]
    sigma_px = float(np.median(sigma))
    starts = [*_shifted(T_cam_w, xyz[of_rest], uv, K, sigma_px)]
    drawn = np.flatnonzero(rank[rest] < N_DRAWN)
    if len(drawn) >= MIN_CONSENSUS:
        size_px = sight.camera.size_px
        starts.append(resect(K, size_px, uv[drawn], xyz[of_rest[drawn]], sigma_px, seed, HYPOTHESES).T_cam_w)
    same_px = SAME_PX * max(sigma_px, _spread_px(sight, T_cam_w, point, feature))
    found: list[SecondPose] = []
    for T_start in starts:
        near = sight.explained(T_start, of_rest, at_rest, SAME_PX)
        if np.count_nonzero(near) < MIN_CONSENSUS:
            continue
        refined = refine_pose(K, T_start, xyz[of_rest[near]], uv[near], sigma[near])
        if isinstance(refined, Failure):
            continue
        T = refined.T_cam_w
        held = np.unique(point[sight.explained(T, point, feature, AGREES)])
        if len(held) < MIN_CONSENSUS or _are_one(T_cam_w, T, xyz[held], K, same_px):
            continue
        found.append(SecondPose(T, len(held), first_support, sight.n_in_view(T), first_in_view))
    others: list[SecondPose] = []
    for second in sorted(found, key=lambda second: second.support / second.in_view, reverse=True):
        if not any(_are_one(second.T_cam_w, other.T_cam_w, xyz, K, same_px) for other in others):
            others.append(second)
    return others


def _shifted(
    T_cam_w: FloatArray, xyz: FloatArray, uv_px: FloatArray, K: FloatArray, sigma_px: float
) -> Iterator[FloatArray]:
    """Yield poses beside the first one that many pairs ask for: what is moved by a period seldom turns as well.

    A camera that has moved sideways by d sees a point at depth z moved by ``- f d / z``: each pair votes for one d.
    """
    uv, depth = project_points(K, T_cam_w, xyz)
    seen = depth > 0
    if not seen.any():
        return
    votes = (uv_px[seen] - uv[seen]) * depth[seen, None] / K[0, 0]
    radius = SAME_PX * sigma_px * float(np.median(depth[seen])) / K[0, 0]
    left = np.linalg.norm(votes, axis=1) > radius
    tree = cKDTree(votes)
    density = np.asarray(tree.query_ball_point(votes, radius / 2.0, return_length=True))
    for _ in range(N_MODES):
        if not left.any():
            return
        top = int(np.argmax(np.where(left, density, -1)))
        T_shifted = T_cam_w.copy()
        T_shifted[:2, 3] += votes[top]
        yield T_shifted
        left &= np.linalg.norm(votes - votes[top], axis=1) > radius


def match_under(sight: Sight, T_cam_w: FloatArray) -> Matches:
    """Match what is known with the copy that lies where a pose shows it, which need not look most alike."""
    distance = all_distances(sight.frontend, sight.descriptors, sight.features.descriptors)
    i, j = np.nonzero(distance <= sight.frontend.max_distance_strict)
    near = sight.explained(T_cam_w, i, j, SAME_PX)
    i, j = i[near], j[near]
    cost = np.asarray(distance[i, j], np.float64)
    best_of_both = np.intersect1d(
        best_per_group(i, cost, len(sight.xyz)), best_per_group(j, cost, len(sight.features)), assume_unique=True
    )
    best_of_both = best_of_both[np.argsort(cost[best_of_both], kind="stable")]
    return Matches(np.column_stack([i[best_of_both], j[best_of_both]]), cost[best_of_both])


def _spread(n: int, at_most: int) -> IntArray:
    return np.linspace(0, n - 1, min(n, at_most)).round().astype(np.int64)


def _alike(frontend: Frontend, a: NDArray[np.generic], b: NDArray[np.generic]) -> tuple[IntArray, IntArray, IntArray]:
    """Return pairs of similar rows, for each of a the `N_ALIKE` nearest of b, and the rank among these, from 0 on."""
    if not len(a) or not len(b):
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64)
    distance = all_distances(frontend, a, b)
    i, j = np.nonzero(distance <= frontend.max_distance_strict)
    nearest_first = np.lexsort((distance[i, j], i))
    i, j = i[nearest_first], j[nearest_first]
    rank = rank_in_runs(i)
    among_nearest = rank < N_ALIKE
    return i[among_nearest], j[among_nearest], rank[among_nearest]


def _spread_px(sight: Sight, T_cam_w: FloatArray, point: IntArray, feature: IntArray) -> float:
    """Return the sigma of the pairs that a pose explains or nearly does: pixels and points are uncertain."""
    uv, depth = project_points(sight.K, T_cam_w, sight.xyz[point])
    off_px = np.where(depth > 0, np.linalg.norm(uv - sight.features.uv_rect_px[feature], axis=1), np.inf)
    nearest = lowest_in_group(point, off_px, len(sight.xyz))
    near = nearest[nearest < 4 * SAME_PX * float(np.median(sight.features.sigma_px))]
    return float(np.median(near) / np.sqrt(MEDIAN_CHI2[2])) if len(near) else 0.0


def _are_one(T_a: FloatArray, T_b: FloatArray, xyz: FloatArray, K: FloatArray, same_px: float) -> bool:
    """Whether two poses show the points at one place."""
    (uv_a, depth_a), (uv_b, _) = project_points(K, T_a, xyz), project_points(K, T_b, xyz)
    apart = np.where(depth_a > 0, np.linalg.norm(uv_a - uv_b, axis=1), np.inf)
    return bool(np.median(apart) < same_px)
