"""Place recognition in a large map, made of descriptors alone: memory, insertion, query, and whether it is right.

python benchmarks/places.py [--keyframes 10000]

Descriptors are those of rendered streets, so that they fall into the cells as real ones do: a landmark is one of them
with `NEW_BITS` bits changed, each sight of it is the landmark with `SIGHT_BITS` changed. A camera that has passed a
place comes by again, and half of what its image shows are landmarks of that place.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from numpy.typing import NDArray

from dualslam.core.config.settings import Config
from dualslam.core.resources import peak_rss_mb
from dualslam.core.types import Features, Keyframe
from dualslam.frontends.features.orb import hamming_distance
from dualslam.frontends.registry import create_frontend
from dualslam.lab.synthetic import make_sequence
from dualslam.map.submap import Submap
from dualslam.places.faiss_index import FaissRecogniser

N_FEATURES, N_SEEN, N_NEW = 1000, 250, 40
"""Of a keyframe: features, landmarks that it sees, and those that it is the first to see. 7-Scenes has the like."""
PER_SUBMAP = 200
NEW_BITS, SIGHT_BITS = 30, 16
N_POOLED = 10
"""Frames of each of four streets whose descriptors are the pool."""
N_QUERIES = 200
MAX_DISTANCE = 50.0
K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])


def changed(descriptors: NDArray[np.uint8], n_bits: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return descriptors with up to `n_bits` bits turned over in each."""
    changed = descriptors.copy()
    rows = np.arange(len(changed))
    for _ in range(n_bits):
        bit = rng.integers(0, 256, len(changed))
        changed[rows, bit // 8] ^= (1 << (bit % 8)).astype(np.uint8)
    return changed


def descriptor_pool() -> NDArray[np.uint8]:
    """Return the descriptors (N, 32) of rendered streets."""
    front_end, found = create_frontend(Config().frontend), []
    for seed in range(4):
        world = make_sequence("street", 10 * N_POOLED, seed)
        found += [front_end.extract(world.frame(10 * i).image).descriptors for i in range(N_POOLED)]
    return np.concatenate(found).astype(np.uint8)


def features_of(descriptors: NDArray[np.uint8]) -> Features:
    """Return features of which only the descriptors mean anything."""
    n = len(descriptors)
    uv, one = np.zeros((n, 2)), np.ones(n)
    return Features(uv, uv, one, one, np.zeros(n, np.int64), np.zeros(n), descriptors)


def grow(submap: Submap, keyframe_id: int, pool: NDArray[np.uint8], rng: np.random.Generator) -> None:
    """Add a keyframe that sees the newest landmarks again, and some for the first time."""
    n_old = min(N_SEEN - N_NEW, len(submap.landmarks))
    old = np.arange(len(submap.landmarks) - n_old, len(submap.landmarks))
    own = changed(pool[rng.integers(0, len(pool), N_NEW)], NEW_BITS, rng)
    seen = np.concatenate([submap.landmarks["descriptor"][old], own])
    rest = pool[rng.integers(0, len(pool), N_FEATURES - len(seen))]
    descriptors = np.concatenate([changed(seen, SIGHT_BITS, rng), changed(rest, NEW_BITS, rng)])
    submap.add_keyframe(Keyframe(keyframe_id, 0.1 * keyframe_id, features_of(descriptors)), np.eye(4))
    new = submap.add_landmarks(rng.normal(size=(N_NEW, 3)) + [0, 0, 5], own, np.ones(N_NEW), keyframe_id)
    ids = np.concatenate([old, new])
    submap.add_observations(keyframe_id, np.arange(len(ids)), ids)


def main() -> None:
    """Build the map, and print what it costs and finds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keyframes", type=int, default=10_000)
    n_keyframes = parser.parse_args().keyframes
    rng = np.random.default_rng(0)
    pool = descriptor_pool()
    index, submaps = FaissRecogniser(hamming_distance, MAX_DISTANCE), dict[int, Submap]()
    insertion: list[float] = []
    for k in range(n_keyframes):
        m = k // PER_SUBMAP
        if m not in submaps:
            submaps[m] = Submap(m, K, pool[0])
        grow(submaps[m], k, pool, rng)
        began = time.perf_counter()
        index.take_in(submaps[m])
        insertion.append(time.perf_counter() - began)
    seconds, first, any_of_three = [], 0, 0
    for _ in range(N_QUERIES):
        k = int(rng.integers(0, n_keyframes))
        seen = submaps[k // PER_SUBMAP].landmark_of[k]
        shown = rng.permutation(seen[seen >= 0])[: N_SEEN // 2]
        descriptors = changed(submaps[k // PER_SUBMAP].landmarks["descriptor"][shown], 2 * SIGHT_BITS, rng)
        rest = changed(pool[rng.integers(0, len(pool), N_FEATURES - len(shown))], NEW_BITS, rng)
        asked = features_of(np.concatenate([descriptors, rest]))
        began = time.perf_counter()
        found = index.query(asked, submaps)
        seconds.append(time.perf_counter() - began)
        near = [abs(c.keyframe_id - k) <= 5 for c in found]
        first += bool(near and near[0])
        any_of_three += any(near)
    ms = 1e3 * np.array(seconds)
    n_bytes = sum(keyframe.features.nbytes for s in submaps.values() for keyframe in s.keyframes.values())
    print(f"{n_keyframes} keyframes in {len(submaps)} submaps, {len(index)} landmarks")
    print(f"index {index.nbytes / 1e6:.0f} MB, keyframes' features {n_bytes / 1e6:.0f} MB, peak {peak_rss_mb():.0f} MB")
    print(f"insertion of a keyframe {1e3 * np.mean(insertion):.2f} ms, the slowest {1e3 * max(insertion):.1f} ms")
    print(f"query {np.median(ms):.1f} ms median, {np.percentile(ms, 95):.1f} ms p95")
    print(f"right keyframe first {first} of {N_QUERIES}, among the candidates {any_of_three}")


if __name__ == "__main__":
    main()
