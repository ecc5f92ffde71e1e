"""Hamming distances of binary descriptors: of pairs by numpy, of all with all by FAISS."""

from __future__ import annotations

import faiss
import numpy as np
from numpy.typing import NDArray

from dualslam.core.types import FloatArray


def hamming_distance(a: NDArray[np.generic], b: NDArray[np.generic]) -> FloatArray:
    """Differing bits of paired descriptors (N, 8 k) uint8, (N, 8 k) uint8 -> (N,) float64."""
    words_a, words_b = (np.ascontiguousarray(each).view(np.uint64) for each in (a, b))
    different = np.bitwise_count(words_a ^ words_b).astype(np.uint16)
    # Word by word: numpy's sum along rows of four takes four times as long.
    total = np.zeros(len(different), np.uint16)
    for word in different.T:
        total += word
    return total.astype(np.float64)


def hamming_matrix(a: NDArray[np.generic], b: NDArray[np.generic]) -> NDArray[np.int32]:
    """Differing bits of all pairs of descriptors (N, 8 k) uint8, (M, 8 k) uint8 -> (N, M).

    FAISS takes a quarter of numpy's time, and a twelfth of OpenCV's matcher's.
    """
    a, b = np.ascontiguousarray(a), np.ascontiguousarray(b)
    distances = np.empty((len(a), len(b)), np.int32)
    faiss.hammings(  # type: ignore[attr-defined]  # left out of its stubs
        faiss.swig_ptr(a), faiss.swig_ptr(b), len(a), len(b), a.shape[1], faiss.swig_ptr(distances)
    )
    return distances
