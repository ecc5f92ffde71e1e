"""The two sides of a candidate place: keyframes about it, pairs of landmarks between them, and what both show."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from dualslam.core.arrays import first_in_both
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.geometry.alignment import estimate_sim3_robust
from dualslam.core.interfaces import Frontend
from dualslam.core.matchers import Sighting
from dualslam.core.noise_model import GROUP, MIN_CONSENSUS, SAME_WITHIN, TINY
from dualslam.core.types import BoolArray, Failure, FloatArray, IntArray
from dualslam.map.submap import Submap


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """One side: a submap, the keyframe in question with those around it, and all that these see."""

    submap: Submap
    keyframes: list[int]
    landmarks: IntArray

    @property
    def id(self) -> tuple[int, int]:
        """Submap and keyframe."""
        return self.submap.id, self.keyframes[0]


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Landmarks of the place and of the query, one to one, with their noise."""

    place: IntArray
    query: IntArray
    xyz_place: FloatArray
    xyz_query: FloatArray
    cov_place: FloatArray
    cov_query: FloatArray

    def fixed(self) -> Pairs:
        """Return the pairs of which both landmarks are fixed by their views."""
        rows = np.isfinite(self.cov_place).all((1, 2)) & np.isfinite(self.cov_query).all((1, 2))
        return Pairs(*(getattr(self, each.name)[rows] for each in fields(self)))

    def mahalanobis2(self, S: FloatArray) -> FloatArray:
        """Return the squared distances (N,) of the pairs under a similarity, by their noise."""
        A = S[:3, :3]
        residual = self.xyz_place - sim3.act(S, self.xyz_query)
        covariance = self.cov_place + A @ self.cov_query @ A.T
        return np.asarray((residual * np.linalg.solve(covariance, residual[..., None])[..., 0]).sum(1))


@dataclass(frozen=True, slots=True, eq=False)
class Looks:
    """Result of a two-way search: each side's landmarks in the images of the other, and the resulting pairs."""

    in_query: list[Sighting]
    pairs: list[tuple[IntArray, IntArray]]

    @property
    def found(self) -> float:
        """Share of what the place should show that the query's images show: of the middle one of them."""
        return float(np.median([look.share for look in self.in_query]))


def side_of(submap: Submap, keyframe_id: int) -> Side:
    """Return a keyframe with those that see most of its landmarks."""
    covisible, shared = submap.covisible(submap.seen_in(keyframe_id))
    others = [
        k
        for k, n in zip(covisible.tolist(), shared.tolist(), strict=True)
        if k != keyframe_id and k not in submap.condemned and n >= MIN_CONSENSUS
    ]
    keyframes = [keyframe_id, *others[: GROUP - 1]]
    return Side(submap, keyframes, submap.landmarks_of_keyframes(keyframes))


def seen_as(look: Sighting, landmark_of: IntArray) -> tuple[IntArray, IntArray]:
    """Return the landmarks that were looked for and found, and the landmarks that the image's own map has there."""
    found = look.feature >= 0
    own = landmark_of[look.feature[found]]
    return look.landmark_ids[found][own >= 0], own[own >= 0]


def one_to_one(votes: list[tuple[IntArray, IntArray]]) -> tuple[IntArray, IntArray]:
    """Return pairs of landmarks of which either is the other's most frequent partner, ascending."""
    a, b = (np.concatenate([np.zeros(0, np.int64), *column]) for column in zip(*votes, strict=True))
    pairs, n = np.unique(np.stack([a, b], 1), axis=0, return_counts=True)
    order = np.argsort(-n, kind="stable")
    chosen = pairs[np.sort(order[first_in_both(*pairs[order].T)])]
    return chosen[:, 0], chosen[:, 1]


def keyframes_seeing(side: Side, landmark_ids: IntArray, at_least: int) -> tuple[int, ...]:
    """Return the keyframes of a side that see so many of the landmarks, ascending."""
    counts = {k: int(np.isin(side.submap.landmark_of[k], landmark_ids).sum()) for k in side.keyframes}
    return tuple(sorted(k for k, n in counts.items() if n >= at_least))


def image_spread(submap: Submap, keyframes: tuple[int, ...], landmark_ids: IntArray) -> float:
    """Return the share of the image, along the axis where it is less, that landmarks cover in the best keyframe."""
    best = 0.0
    for k in keyframes:
        uv = submap.keyframes[k].features.uv_rect_px
        seen = uv[np.isin(submap.landmark_of[k], landmark_ids)]
        covered, there = (np.ptp(np.percentile(pixels, [5, 95], axis=0), axis=0) for pixels in (seen, uv))
        best = max(best, float((covered / np.maximum(there, TINY)).min()))
    return best


def sigmas_at_pairs(xyz_query: FloatArray, S: FloatArray, covariance: FloatArray, place: Side) -> dict[str, float]:
    """Return the sigmas of scale (relative), rotation, and position at the pairs' centre relative to their depth."""
    at_centre = sim3.adjoint(se3.from_parts(so3.IDENTITY, -np.median(xyz_query, axis=0)))
    C = at_centre @ covariance @ at_centre.T
    depth = np.median(
        np.linalg.norm(sim3.act(S, xyz_query) - se3.translation(place.submap.T_submap_kf[place.keyframes[0]]), axis=1)
    )
    position = float(sim3.scale(S)) * math.sqrt(np.linalg.eigvalsh(C[3:6, 3:6])[-1])
    return {
        "sigma_scale": math.sqrt(C[6, 6]),
        "sigma_rot_deg": math.degrees(math.sqrt(np.linalg.eigvalsh(C[:3, :3])[-1])),
        "sigma_trans_rel": position / max(float(depth), TINY),
    }


N_ALIKE = 4
"""Landmarks of the other map that one landmark is paired with: how many copies of a thing are told apart."""


@dataclass(frozen=True, slots=True, eq=False)
class SecondSimilarity:
    """Another similarity, and how many landmarks it explains."""

    S_dst_src: FloatArray  # (4, 4)
    # Landmarks of src that the second and the first one explain.
    support: int
    first_support: int


def alike(a: NDArray[np.generic], b: NDArray[np.generic], frontend: Frontend) -> tuple[IntArray, IntArray]:
    """Return all pairs of rows that look alike: for each of a the `N_ALIKE` nearest of b that are near enough.

    `a`, `b` (N, D), (M, D): descriptors.
    """
    if not len(a) or not len(b):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    rows, columns = (index.ravel() for index in np.indices((len(a), len(b))))
    distance = np.asarray(frontend.distance(a[rows], b[columns])).reshape(len(a), len(b))
    n = min(N_ALIKE, len(b))
    nearest = np.argsort(distance, axis=1, kind="stable")[:, :n]
    near = np.take_along_axis(distance, nearest, axis=1) <= frontend.max_distance_strict
    i, column = np.nonzero(near)
    return i, nearest[i, column]


def find_second_pose(
    src: FloatArray,
    dst: FloatArray,
    cov_src: FloatArray,
    cov_dst: FloatArray,
    point: IntArray,
    S_first: FloatArray,
    explained: BoolArray,
    rng: Generator,
    *,
    min_support: int,
    chi2_gate: float,
    max_hypotheses: int,
) -> SecondSimilarity | None:
    """Look for another similarity among the pairs that the first one leaves over.

    - `cov_src`, `cov_dst` (P, 3, 3), `S_first` (4, 4).
    - `src`, `dst` (P, 3): all pairs that look alike; a point may stand in several.
    - `point` (P,): which point of src a pair is of: each counts once.
    - `explained` (P,) bool: whether the first similarity agrees with the pair.
    - `min_support`: fewer points are no second pose.
    - `chi2_gate`, `max_hypotheses`: as for `estimate_sim3_robust`.
    """
    first_support = len(np.unique(point[explained]))
    rest = np.flatnonzero(~explained)
    if len(rest) < min_support:
        return None
    second = estimate_sim3_robust(
        src[rest],
        dst[rest],
        cov_src[rest],
        cov_dst[rest],
        rng,
        min_inliers=min_support,
        max_hypotheses=max_hypotheses,
        chi2_gate=chi2_gate,
    )
    if isinstance(second, Failure):
        return None
    support = len(np.unique(point[rest[second.inliers]]))
    if support < min_support or _are_one(S_first, second.S_dst_src, src[rest[second.inliers]]):
        return None
    return SecondSimilarity(sim3.normalise(second.S_dst_src), support, first_support)


def _are_one(S_a: FloatArray, S_b: FloatArray, src: FloatArray) -> bool:
    """Whether two similarities do the same to points, by what counts as a wrong link (`LinkingConfig`)."""
    moved_a, moved_b = sim3.act(S_a, src), sim3.act(S_b, src)
    size = np.sqrt(((moved_a - moved_a.mean(0)) ** 2).sum(1).mean())
    return bool(np.sqrt(((moved_a - moved_b) ** 2).sum(1).mean()) < SAME_WITHIN * size)
