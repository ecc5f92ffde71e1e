"""Distances of binary descriptors, against bits that are counted one by one."""

import numpy as np
import pytest

from dualslam.frontends.features.orb import hamming_distance, hamming_matrix


def _counted(a, b):
    return (np.unpackbits(a, axis=-1) != np.unpackbits(b, axis=-1)).sum(axis=-1)


@pytest.mark.parametrize("n_bytes", [8, 32, 64])
def test_all_pairs_and_single_pairs_have_the_distance_that_their_bits_have(n_bytes):
    a, b = np.random.default_rng(n_bytes).integers(0, 256, (2, 37, n_bytes), dtype=np.uint8)
    assert (hamming_matrix(a, b[:20]) == _counted(a[:, None], b[None, :20])).all()
    assert (hamming_distance(a, b) == _counted(a, b)).all()


def test_rows_of_a_larger_table_and_none_at_all_may_be_compared():
    table = np.random.default_rng(0).integers(0, 256, (30, 64), dtype=np.uint8)
    a, b = table[::2, :32], table[1::3, 32:]
    assert (hamming_matrix(a, b) == _counted(a[:, None], b[None])).all()
    assert hamming_matrix(a[:0], b).shape == (0, 10)
    assert hamming_matrix(a, b[:0]).shape == (15, 0)
