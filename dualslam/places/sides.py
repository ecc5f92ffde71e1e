"""The two sides of a candidate place: keyframes about it, pairs of landmarks between them, and what both show."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dualslam.core.geometry import se3, sim3
from dualslam.core.place_matcher import Sighting
from dualslam.core.types import FloatArray, IntArray
from dualslam.map.submap import Submap

GROUP = 5
"""Keyframes on a side: the one in question and the four that see most of the same landmarks."""
MIN_FIRST_MATCHES = 12
"""Matches between the two keyframes themselves, the best of the candidate's group: fewer, and no more is tried."""


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
    ids = submap.landmark_of[keyframe_id]
    covisible, shared = submap.covisible(ids[ids >= 0])
    others = [
        k
        for k, n in zip(covisible.tolist(), shared.tolist(), strict=True)
        if k != keyframe_id and k not in submap.condemned and n >= MIN_FIRST_MATCHES
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
    order = np.lexsort((pairs[:, 1], pairs[:, 0], -n))
    taken_a: set[int] = set()
    taken_b: set[int] = set()
    kept = []
    for row in order.tolist():
        i, j = pairs[row].tolist()
        if i not in taken_a and j not in taken_b:
            taken_a.add(i)
            taken_b.add(j)
            kept.append(row)
    chosen = pairs[sorted(kept)]
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
        best = max(best, float((covered / np.maximum(there, 1e-9)).min()))
    return best


def sigmas_at_pairs(xyz_query: FloatArray, S: FloatArray, covariance: FloatArray, place: Side) -> dict[str, float]:
    """Return the sigmas of scale (relative), rotation, and position at the pairs' centre relative to their depth."""
    at_centre = sim3.adjoint(se3.from_parts(np.eye(3), -np.median(xyz_query, axis=0)))
    C = at_centre @ covariance @ at_centre.T
    depth = np.median(
        np.linalg.norm(sim3.act(S, xyz_query) - place.submap.T_submap_kf[place.keyframes[0]][:3, 3], axis=1)
    )
    position = float(sim3.scale(S)) * math.sqrt(np.linalg.eigvalsh(C[3:6, 3:6])[-1])
    return {
        "sigma_scale": math.sqrt(C[6, 6]),
        "sigma_rot_deg": math.degrees(math.sqrt(np.linalg.eigvalsh(C[:3, :3])[-1])),
        "sigma_trans_rel": position / max(float(depth), 1e-12),
    }
