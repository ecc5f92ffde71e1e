"""Images that resemble each other, by the nearest of their largest features."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import faiss
import numpy as np
from numpy.typing import NDArray

from dualslam.core.types import Features
from dualslam.places.faiss_index import N_NEAREST, DescriptorDistance, step_of

N_COMPARED = 200
"""Features of an image that are compared, the largest: those that it shares with images from farther or nearer."""
N_ALIKE = 16
"""Images named for each."""
MIN_PAIRS = 3
"""Features in common from which an image is named."""


def find_resembling(
    images: Mapping[int, Features],
    asked: Collection[int],
    apart: int,
    distance: DescriptorDistance,
    max_distance: float,
) -> dict[int, list[int]]:
    """Return for some images those that they resemble, the best first.

    Nearest descriptors are found by their bits, then compared. Numbers become bits by the median of each column. That
    takes a tenth of the time of an exhaustive search by numbers.

    - `images`: features by the number of the frame.
    - `asked`: the frames that answers are for. Where one of them names another frame, that one names it, too.
    - `apart`: frames closer than this are not named.
    - `distance`, `max_distance`: as for `FaissRecogniser`.
    """
    order = [i for i in sorted(images) if len(images[i])]
    if not order:
        return {}
    largest = {i: images[i].descriptors[np.argsort(-images[i].scale, kind="stable")[:N_COMPARED]] for i in order}
    owner = np.repeat(order, [len(largest[i]) for i in order])
    descriptors = np.concatenate([largest[i] for i in order])
    numbers = step_of(distance, descriptors[:1]) is not None
    bits = _bits_of(descriptors) if numbers else np.ascontiguousarray(descriptors)
    index = faiss.IndexBinaryFlat(8 * bits.shape[1])
    index.add(bits)
    votes: dict[int, dict[int, int]] = {i: {} for i in order}
    # The nearest of all is the descriptor itself.
    n_found = min(N_NEAREST + 1, len(bits))
    for i in sorted(set(asked) & votes.keys()):
        own = np.flatnonzero(owner == i)
        found = index.search(bits[own], n_found)[1]
        feature, row = np.repeat(own, n_found), found.ravel()
        near = np.abs(owner[row] - i) >= apart
        feature, row = feature[near], row[near]
        near = distance(descriptors[feature], descriptors[row]) <= max_distance
        pairs = np.unique(np.column_stack((owner[row[near]], feature[near])), axis=0)
        other, n = np.unique(pairs[:, 0], return_counts=True)
        for j, n_pairs in zip(other.tolist(), n.tolist(), strict=True):
            if n_pairs >= MIN_PAIRS:
                votes[i][j] = votes[j][i] = max(n_pairs, votes[i].get(j, 0))
    return {i: sorted(found, key=lambda j: (-found[j], j))[:N_ALIKE] for i, found in votes.items() if found}


def _bits_of(descriptors: NDArray[Any]) -> NDArray[np.uint8]:
    """Return for each number whether it is above the median of its column, eight to a byte."""
    return np.packbits(descriptors > np.median(descriptors, axis=0), axis=1)
