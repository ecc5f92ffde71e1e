"""The first of equal values."""

import numpy as np

from dualslam.core.firsts import is_first


def test_the_first_of_each_is_told() -> None:
    assert is_first(np.array([3, 1, 3, 2, 1, 3])).tolist() == [True, True, False, True, False, False]
    assert is_first(np.zeros(0, np.int64)).tolist() == []
