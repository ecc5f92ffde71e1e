"""Test for a second similarity that explains nearly as much: then the scene repeats itself, and no match decides.

Matching with a test of the second best throws out just those matches that would show a repetition. Here every landmark
is paired with all similar ones. Pairs that the first similarity explains are removed, and the rest is searched for
another one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from dualslam.core.geometry import sim3
from dualslam.core.geometry.alignment import estimate_sim3_robust
from dualslam.core.place_matcher import PlaceMatcher
from dualslam.core.types import BoolArray, Failure, FloatArray, IntArray

SAME_SHARE = 0.1
"""Distance, of the size of what they move, within which two similarities are one: twice the 5 % of a wrong link."""
N_ALIKE = 4
"""Landmarks of the other map that one landmark is paired with: the number of copies of a thing that can be
distinguished."""


@dataclass(frozen=True, slots=True, eq=False)
class SecondSimilarity:
    """Another similarity, and how many landmarks it explains."""

    S_dst_src: FloatArray  # (4, 4)
    # Landmarks of src that the second and the first one explain.
    support: int
    first_support: int


def alike(a: NDArray[np.generic], b: NDArray[np.generic], matcher: PlaceMatcher) -> tuple[IntArray, IntArray]:
    """Return all pairs of rows that look alike: for each of a the `N_ALIKE` nearest of b that are near enough.

    `a`, `b` (N, D), (M, D): descriptors.
    """
    if not len(a) or not len(b):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    rows, columns = (index.ravel() for index in np.indices((len(a), len(b))))
    distance = np.asarray(matcher.distance(a[rows], b[columns])).reshape(len(a), len(b))
    n = min(N_ALIKE, len(b))
    nearest = np.argsort(distance, axis=1, kind="stable")[:, :n]
    near = np.take_along_axis(distance, nearest, axis=1) <= matcher.max_distance_strict
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
    return bool(np.sqrt(((moved_a - moved_b) ** 2).sum(1).mean()) < SAME_SHARE * size)
