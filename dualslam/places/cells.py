"""The cells that binary descriptors are sorted into: fixed, shipped, made by ``tools/train_places.py``."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

CELLS = Path(__file__).with_name("cells.npy")
N_CELLS = 1024


@cache
def shipped_cells() -> NDArray[np.uint8]:
    """Return the centres (1024, 32) of the cells, of ORB descriptors of rendered worlds."""
    cells: NDArray[np.uint8] = np.load(CELLS, allow_pickle=False)
    cells.setflags(write=False)
    return cells
