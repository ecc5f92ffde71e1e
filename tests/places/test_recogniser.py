"""Votes of landmarks find the keyframes that show a place."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from dualslam.core.types import Features, FloatArray, Keyframe
from dualslam.frontends.features.orb import hamming_distance
from dualslam.frontends.features.sift import SiftFrontend
from dualslam.map.submap import Submap
from dualslam.places import FaissRecogniser
from dualslam.places.faiss_index import shipped_cells
from tests.places.worlds import N_LAP, driven_lap, lap

MAX_BITS = 50.0


def test_the_cells_are_shipped() -> None:
    cells = shipped_cells()
    assert cells.shape == (1024, 32)
    assert cells.dtype == np.uint8
    assert len(np.unique(cells, axis=0)) == len(cells)


def test_a_frame_finds_the_keyframes_that_stood_where_it_stands() -> None:
    submap = driven_lap().atlas.submaps[0]
    recogniser = FaissRecogniser(hamming_distance, MAX_BITS)
    assert recogniser.take_in(submap) > 500
    assert recogniser.take_in(submap) == 0
    assert len(recogniser) * 32 < recogniser.nbytes < len(recogniser) * 100
    first_lap = [k for k in submap.keyframes if k < N_LAP // 2]
    for i in (N_LAP + 3, N_LAP + 12, N_LAP + 20):
        best = recogniser.query(lap().features(i), {0: submap}, lambda m, k: k in first_lap)[0]
        assert best.submap_id == 0
        assert abs(best.keyframe_id - (i - N_LAP)) <= 10


def test_the_same_calls_give_the_same_candidates() -> None:
    submap = driven_lap().atlas.submaps[0]
    answers = []
    for _ in range(2):
        recogniser = FaissRecogniser(hamming_distance, MAX_BITS)
        recogniser.take_in(submap, n_newest_left_out=5)
        recogniser.take_in(submap)
        answers.append([recogniser.query(lap().features(i), {0: submap}) for i in (5, 40, 80)])
    assert answers[0] == answers[1]
    assert all(answers[0])


def test_what_is_taken_in_by_parts_gives_the_same_candidates() -> None:
    submap = driven_lap().atlas.submaps[0]
    whole, parts = FaissRecogniser(hamming_distance, MAX_BITS), FaissRecogniser(hamming_distance, MAX_BITS)
    whole.take_in(submap)
    for _ in range(0, len(submap.landmarks), 200):
        assert parts.take_in(submap, at_most=200) <= 200
    assert len(parts) == len(whole)
    assert parts.take_in(submap) == 0
    for i in (5, 40, 80):
        assert parts.query(lap().features(i), {0: submap}) == whole.query(lap().features(i), {0: submap})


def test_candidates_are_of_different_places() -> None:
    submap = driven_lap().atlas.submaps[0]
    recogniser = FaissRecogniser(hamming_distance, MAX_BITS)
    recogniser.take_in(submap)
    found = recogniser.query(lap().features(30), {0: submap})
    keyframes = [candidate.keyframe_id for candidate in found]
    assert len(keyframes) == len(set(keyframes))
    ids = [set(submap.landmark_of[k][submap.landmark_of[k] >= 0].tolist()) for k in keyframes]
    for n, own in enumerate(ids):
        for other in ids[:n]:
            assert len(own & other) < 0.3 * min(len(own), len(other))


def test_culled_landmarks_have_no_vote_and_condemned_keyframes_are_not_proposed() -> None:
    submap = driven_lap().atlas.submaps[0].copy()
    recogniser = FaissRecogniser(hamming_distance, MAX_BITS)
    recogniser.take_in(submap)
    best = recogniser.query(lap().features(30), {0: submap})[0]
    submap.condemn([best.keyframe_id])
    assert best not in recogniser.query(lap().features(30), {0: submap})
    submap.remove_landmarks(np.flatnonzero(submap.landmarks["alive"]))
    assert recogniser.query(lap().features(30), {0: submap}) == []


def test_nothing_is_found_in_an_empty_index_or_image() -> None:
    submap = driven_lap().atlas.submaps[0]
    recogniser = FaissRecogniser(hamming_distance, MAX_BITS)
    assert recogniser.query(lap().features(30), {0: submap}) == []
    recogniser.take_in(submap)
    nothing = lap().features(30).take(np.zeros(0, np.int64))
    assert recogniser.query(nothing, {0: submap}) == []


def _norm(a: NDArray[np.generic], b: NDArray[np.generic]) -> FloatArray:
    return np.linalg.norm(a.astype(np.float64) - b.astype(np.float64), axis=1)


@pytest.mark.parametrize(
    ("distance", "max_distance", "unit", "length"),
    [(hamming_distance, 20.0, None, 16), (_norm, 0.5, 1, 64), (SiftFrontend().distance, 0.4, 512, 128)],
    ids=["bits", "floats", "numbers of a byte"],
)
def test_other_descriptors_are_searched_by_the_distance_of_their_front_end(
    distance: Callable[..., FloatArray], max_distance: float, unit: int | None, length: int
) -> None:
    """Each keyframe is found by its own landmarks, seen with some noise, and no other one is."""
    rng = np.random.default_rng(0)
    n = 40
    if unit is None:
        words = rng.integers(0, 256, (3, n, length), np.uint8)
        seen = words ^ (rng.random(words.shape) < 0.05).astype(np.uint8)
    else:
        numbers = rng.exponential(size=(3, n, length))
        noisy = np.stack([numbers, numbers + rng.normal(scale=0.2, size=numbers.shape)])
        noisy *= unit / np.linalg.norm(noisy, axis=-1, keepdims=True)
        words, seen = noisy.astype(np.float32) if unit == 1 else noisy.round().clip(0, 255).astype(np.uint8)
    submap = Submap(0, np.eye(3), words[0, 0])
    for k in range(3):
        features = _features(words[k])
        submap.add_keyframe(Keyframe(k, float(k), features), np.eye(4))
        ids = submap.add_landmarks(rng.normal(size=(n, 3)), words[k], np.ones(n), k)
        submap.add_observations(k, np.arange(n), ids)
    recogniser = FaissRecogniser(distance, max_distance)
    recogniser.take_in(submap)
    for k in range(3):
        assert [(c.keyframe_id, c.n_votes) for c in recogniser.query(_features(seen[k]), {0: submap})] == [(k, n)]


def _features(descriptors: np.ndarray) -> Features:
    n = len(descriptors)
    zero, uv = np.zeros(n), np.zeros((n, 2))
    return Features(uv, uv, zero + 1, zero + 1, np.zeros(n, np.int64), zero, descriptors)
