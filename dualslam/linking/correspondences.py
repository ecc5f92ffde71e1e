"""Which landmarks of two submaps are the same point: matched through the keyframes that both submaps hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualslam.core.arrays import concatenate, first_in_both
from dualslam.core.types import BoolArray, Features, FloatArray, IntArray
from dualslam.map.landmark_views import landmark_covariances, triangulate_landmarks
from dualslam.map.submap import NO_LANDMARK, Submap


@dataclass(frozen=True, slots=True)
class DescriptorMatcher:
    """How descriptors of the live front end are compared."""

    distance: Callable[[NDArray[np.generic], NDArray[np.generic]], FloatArray]
    """Of paired descriptors (N, D), (N, D) -> (N,)."""
    max_distance: float  # above it two features are not views of the same point
    radius_px: float = 3.0  # pixels within which two keypoints of one image may be the same point, at the finest octave


@dataclass(frozen=True, slots=True, eq=False)
class Correspondences:
    """M pairs of landmarks, one to one, and their V views: shared keyframes in which the pair was matched."""

    landmark_old: IntArray  # (M,)
    landmark_new: IntArray  # (M,)
    # Each in its submap's frame and unit.
    xyz_old: FloatArray  # (M, 3)
    xyz_new: FloatArray  # (M, 3)
    # Of the points given the poses, from all observations of each landmark in its map; finite for every pair.
    covariance_old: FloatArray  # (M, 3, 3)
    covariance_new: FloatArray  # (M, 3, 3)
    shared_pixel: BoolArray
    """(M,): whether both maps use the same keypoint of the same frame somewhere. The two points then share part of
    their noise. Their cross-covariance, which the residual's would be less by, is left out: sigmas come out large."""
    keyframes: IntArray  # (K,): shared keyframes with views, ascending: in order of time
    # Row of the pair, row of `keyframes`.
    view_pair: IntArray  # (V,)
    view_keyframe: IntArray  # (V,)

    def __len__(self) -> int:
        return len(self.landmark_old)

    def pairs_seen_in(self, keyframe_rows: BoolArray) -> BoolArray:
        """Return which pairs (M,) have a view in any of the keyframes marked in `keyframe_rows` (K,)."""
        seen = np.zeros(len(self), bool)
        seen[self.view_pair[keyframe_rows[self.view_keyframe]]] = True
        return seen

    def count_by_keyframe(self, view_mask: BoolArray) -> IntArray:
        """Return how many of the marked views (V,) each keyframe has, (K,)."""
        return np.bincount(self.view_keyframe[view_mask], minlength=len(self.keyframes))


@dataclass(frozen=True, slots=True, eq=False)
class _Votes:
    """Candidate pairs, one row for each keyframe that proposes them."""

    keyframe: IntArray
    landmark_old: IntArray
    landmark_new: IntArray
    distance: FloatArray
    identical: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class MatchedLandmarks:
    """Pairs of landmarks, one to one, fixed by their views or not."""

    votes: _Votes
    landmark_old: IntArray
    landmark_new: IntArray
    pair_of_vote: IntArray  # the pair of each vote, or -1 where it was not kept
    covariance_new: FloatArray  # of the new map's points


def shared_keyframes(old: Submap, new: Submap) -> list[int]:
    """Return the ids of the keyframes (source frames) that both submaps hold, ascending."""
    return sorted(old.keyframes.keys() & new.keyframes.keys())


def propose_correspondences(
    old: Submap, new: Submap, matcher: DescriptorMatcher | None = None, old_before: int | None = None
) -> Correspondences:
    """Match landmarks of two submaps through their shared keyframes.

    In each shared keyframe two landmarks are proposed as one if both maps use the same keypoint of the same image
    (identity). Otherwise their keypoints must be near, and their descriptors each other's nearest. Proposals of several
    keyframes for the same pair are its views; a landmark with several keeps the one with the most keyframes (identity
    first). Pairs whose points are not fixed by their views are left out.

    - `matcher`: without it pairs come from identity alone.
    - `old_before`: the old map's points are placed anew by its keyframes older than this one, and those that these do
      not fix are left out.
    """
    return place_pairs(old, new, match_landmarks(old, new, matcher), old_before)


def match_landmarks(old: Submap, new: Submap, matcher: DescriptorMatcher | None) -> MatchedLandmarks:
    """Find which landmarks are one, as `propose_correspondences` says, wherever their points are."""
    votes = _concatenate([_votes_of_keyframe(old, new, k, matcher) for k in shared_keyframes(old, new)])
    (landmark_old, landmark_new), pair_of_vote = _one_to_one(votes, len(new.landmarks))
    covariance_new = landmark_covariances(new, landmark_new)
    return MatchedLandmarks(votes, landmark_old, landmark_new, pair_of_vote, covariance_new)


def landmarks_shown_in(old: Submap, new: Submap) -> IntArray:
    """Return for each landmark of the new map (L,) the one that it is by identity in the old one, or `NO_LANDMARK`."""
    matched, id_of = match_landmarks(old, new, None), np.full(len(new.landmarks), NO_LANDMARK, np.int64)
    id_of[matched.landmark_new] = matched.landmark_old
    return new.by_heirs(id_of)


def place_pairs(old: Submap, new: Submap, matched: MatchedLandmarks, old_before: int | None) -> Correspondences:
    """Return the pairs whose points are fixed by their views, those of the old map by the keyframes before one."""
    votes, landmark_old, landmark_new = matched.votes, matched.landmark_old, matched.landmark_new
    pair_of_vote, covariance_new = matched.pair_of_vote, matched.covariance_new
    xyz_old, xyz_new = old.landmarks["xyz_mu"][landmark_old], new.landmarks["xyz_mu"][landmark_new]
    if old_before is not None:
        xyz_old = triangulate_landmarks(old, landmark_old, old_before)
    covariance_old = landmark_covariances(old, landmark_old, xyz_old, old_before)
    finite = np.isfinite(np.stack([covariance_old, covariance_new])).all((0, 2, 3))
    fixed = np.asarray(finite, np.bool_)
    row = np.where(fixed, np.cumsum(fixed) - 1, -1)
    rows = np.flatnonzero(pair_of_vote >= 0)
    rows = rows[fixed[pair_of_vote[rows]]]
    view_pair = row[pair_of_vote[rows]]
    keyframes, view_keyframe = np.unique(votes.keyframe[rows], return_inverse=True)
    shared = np.zeros(int(fixed.sum()), bool)
    shared[view_pair[votes.identical[rows]]] = True
    return Correspondences(
        landmark_old=landmark_old[fixed],
        landmark_new=landmark_new[fixed],
        xyz_old=xyz_old[fixed],
        xyz_new=xyz_new[fixed],
        covariance_old=covariance_old[fixed],
        covariance_new=covariance_new[fixed],
        shared_pixel=shared,
        keyframes=keyframes,
        view_pair=view_pair,
        view_keyframe=view_keyframe,
    )


def _votes_of_keyframe(old: Submap, new: Submap, k: int, matcher: DescriptorMatcher | None) -> _Votes:
    """Propose pairs in one shared keyframe: by identity, then by descriptor among what is left."""
    in_old, in_new = old.landmark_of[k], new.landmark_of[k]
    features_old, features_new = old.keyframes[k].features, new.keyframes[k].features
    n_same = features_old.n_common(features_new)
    same = np.flatnonzero((in_old[:n_same] >= 0) & (in_new[:n_same] >= 0))
    rest_old, rest_new = np.flatnonzero(in_old >= 0), np.flatnonzero(in_new >= 0)
    if len(same):
        rest_old, rest_new = np.setdiff1d(rest_old, same), np.setdiff1d(rest_new, same)
    f_old, f_new, distance = same, same, np.zeros(len(same))
    if matcher is not None:
        i, j, d = _match_near(features_old.take(rest_old), features_new.take(rest_new), matcher)
        f_old, f_new = np.concatenate([same, rest_old[i]]), np.concatenate([same, rest_new[j]])
        distance = np.concatenate([distance, d])
    identical = np.arange(len(f_old)) < len(same)
    return _Votes(np.full(len(f_old), k), in_old[f_old], in_new[f_new], distance, identical)


def _match_near(a: Features, b: Features, matcher: DescriptorMatcher) -> tuple[IntArray, IntArray, FloatArray]:
    """Match keypoints of one image that lie close together: mutual nearest descriptors. Returns rows and distances."""
    nothing = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    if not len(a) or not len(b) or a.descriptors.shape[1:] != b.descriptors.shape[1:]:
        return nothing
    i, j = _near_columns(a.uv_rect_px[:, 0], b.uv_rect_px[:, 0], matcher.radius_px * min(a.scale.max(), b.scale.max()))
    apart2 = ((a.uv_rect_px[i] - b.uv_rect_px[j]) ** 2).sum(-1)
    near = apart2 < (matcher.radius_px * np.minimum(a.scale[i], b.scale[j])) ** 2
    i, j, apart2 = i[near], j[near], apart2[near]
    if not len(i):
        return nothing
    d = np.asarray(matcher.distance(a.descriptors[i], b.descriptors[j]), np.float64)
    best_a, best_b = np.full(len(a), np.inf), np.full(len(b), np.inf)
    np.minimum.at(best_a, i, d)
    np.minimum.at(best_b, j, d)
    mutual = np.flatnonzero((d <= best_a[i]) & (d <= best_b[j]) & (d <= matcher.max_distance))
    mutual = mutual[np.lexsort((apart2[mutual], d[mutual]))]  # equal descriptors: the nearer pixels
    keep = first_in_both(i[mutual], j[mutual])
    return i[mutual[keep]], j[mutual[keep]], d[mutual[keep]]


def _near_columns(a: FloatArray, b: FloatArray, radius: float) -> tuple[IntArray, IntArray]:
    """Return all pairs (i, j) with ``|a[i] - b[j]| <= radius``, ascending."""
    order = np.argsort(b, kind="stable")
    first, last = np.searchsorted(b[order], a - radius), np.searchsorted(b[order], a + radius, side="right")
    n = last - first
    i = np.repeat(np.arange(len(a)), n)
    j = order[np.arange(len(i)) - np.repeat(np.cumsum(n) - n - first, n)]
    ascending = np.lexsort((j, i))
    return i, j[ascending]


def _one_to_one(votes: _Votes, n_new: int) -> tuple[tuple[IntArray, IntArray], IntArray]:
    """Merge votes into pairs: ((landmark_old, landmark_new), pair of each vote or -1 where the pair was not kept)."""
    key = votes.landmark_old * max(n_new, 1) + votes.landmark_new
    unique, inverse = np.unique(key, return_inverse=True)
    n_votes = np.bincount(inverse, minlength=len(unique))
    n_identical = np.bincount(inverse[votes.identical], minlength=len(unique))
    distance = np.full(len(unique), np.inf)
    np.minimum.at(distance, inverse, votes.distance)
    order = np.lexsort((unique, distance, -n_votes, -n_identical))
    a, b = unique // max(n_new, 1), unique % max(n_new, 1)
    kept = np.sort(order[first_in_both(a[order], b[order])])
    row = np.full(len(unique), -1)
    row[kept] = np.arange(len(kept))
    return (a[kept], b[kept]), row[inverse]


def _concatenate(parts: list[_Votes]) -> _Votes:
    """Stack the votes of several keyframes."""
    ints, floats, bools = np.zeros(0, np.int64), np.zeros(0), np.zeros(0, bool)
    return concatenate([_Votes(ints, ints, ints, floats, bools), *parts])
