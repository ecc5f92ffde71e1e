"""The search for a revisited place as a background job.

Asking the index is cheap and stays where the map grows. Verification takes as long as several frames: a snapshot goes
to a worker, and verified places come back.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from dualslam.atlas.propagation import follow_keyframes
from dualslam.core.types import Failure, FloatArray
from dualslam.map.submap import Submap
from dualslam.places.verification import PlaceMatch, PlaceVerifier


@dataclass(frozen=True, slots=True)
class PlaceCandidate:
    """A keyframe that may show what an image shows, by descriptors alone."""

    submap_id: int
    keyframe_id: int
    n_votes: int  # features of the image of which a landmark that the keyframe sees is among the nearest


@dataclass(frozen=True, slots=True, eq=False)
class PlaceSearch:
    """A keyframe, and the places that it may show."""

    # Of the keyframe that asks.
    submap_id: int
    keyframe_id: int
    candidates: tuple[PlaceCandidate, ...]  # the most likely first
    submaps: Mapping[int, Submap]  # snapshots of those that are named


def search_places(search: PlaceSearch, verifier: PlaceVerifier) -> list[PlaceMatch | Failure]:
    """Verify the candidates of a search; the result is in their order."""
    submaps, query = search.submaps, (search.submap_id, search.keyframe_id)
    return [
        verifier.verify((submaps[query[0]], query[1]), (submaps[c.submap_id], c.keyframe_id)) for c in search.candidates
    ]


def poses_of(match: PlaceMatch, submaps: Mapping[int, Submap]) -> tuple[FloatArray, FloatArray] | None:
    """Return the poses (4, 4) of a match's two keyframes in their submaps; None where one of them is no more."""
    (a, k_a), (b, k_b) = match.place, match.query
    if a not in submaps or k_a not in submaps[a].keyframes or b not in submaps or k_b not in submaps[b].keyframes:
        return None
    return submaps[a].T_submap_kf[k_a], submaps[b].T_submap_kf[k_b]


def follow_maps(
    match: PlaceMatch, then: tuple[FloatArray, FloatArray], submaps: Mapping[int, Submap]
) -> PlaceMatch | None:
    """Return a match between the current submaps, which have been solved again since it was made.

    None where one of its keyframes is no more. `then`: their poses when the match was made.
    """
    now = poses_of(match, submaps)
    if now is None:
        return None
    if all(np.array_equal(a, b) for a, b in zip(now, then, strict=True)):
        return match
    S, covariance = follow_keyframes(match.S_place_query, match.covariance, then, now)
    return replace(match, S_place_query=S, covariance=covariance)
