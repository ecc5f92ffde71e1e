"""Grid-based motion statistics (Bian et al., CVPR 2017): a match is right where its neighbours move the same way.

Both images are cut into cells. Right matches of one cell end in one cell, and those of its neighbours in the neighbours
of that cell. Wrong ones end anywhere. So the matches between two 3 x 3 blocks of cells are counted. A pair of cells is
accepted if there are more than chance would give (eq. 9: more than alpha standard deviations, alpha = 6).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dualslam.core.errors import ConfigError
from dualslam.core.interfaces import Frontend, NearestSearch
from dualslam.core.types import BoolArray, Features, FloatArray, IntArray, Matches
from dualslam.frontends.features.groups import NO_MATCHES, best_per_group

CELLS = 20
"""Cells along a side of the image (the paper's choice for some thousand matches)."""
THRESHOLD = 6.0
"""The paper's alpha."""
MIN_PER_CELL = 2.2
"""Matches per cell n for which eq. 9 can be met: of 9 n matches a share p is right, and ``9 n p > 6 sqrt(n)`` holds
from p = 45 % on. With fewer matches the cells are made larger."""
ZOOMS = (1.0, 0.5, 0.5**0.5, 2.0**0.5, 2.0)
"""Sizes of the second image's cells that are tried: its cells along a side over those of the first."""
_SHIFTS = ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5))
"""Displacements of the first image's grid, in cells: a motion that a cell's edge cuts in two is whole in another."""
_RING = np.array([0, 1, 2, 5, 8, 7, 6, 3])
"""The cells about the middle of a 3 x 3 block, clockwise."""


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """Matches counted by pairs of cells."""

    match: IntArray  # (V,): matches whose first member is in the grid; `cell_a`, `cell_b` (V,) are their cells
    cell_a: IntArray
    cell_b: IntArray
    counts: NDArray[np.int32]  # (A, B): matches from cell to cell
    n_a: IntArray  # (A,): matches of each cell of the first image
    # Cells with matches, and where most of them go (the first of equals).
    occupied: IntArray  # (O,)
    favourite: IntArray  # (O,)


def supported_matches(
    uv_a: FloatArray,
    uv_b: FloatArray,
    size_a_px: tuple[float, float],
    size_b_px: tuple[float, float],
    *,
    rotation: bool = False,
    zoom: bool = False,
    threshold: float = THRESHOLD,
    cells: int = CELLS,
) -> BoolArray:
    """Which matches their neighbourhood supports.

    - `size_a_px`, `size_b_px` (width, height).
    - `uv_a`, `uv_b` (M, 2): matched pixels, inside the images.
    - `rotation`: also try turns of the second image by multiples of 45 degrees, and take the turn with most support.
    - `zoom`: also try second images of half to twice the size, likewise.
    - `threshold`: the paper's alpha.
    - `cells`: cells along a side.

    Returns (M,) bool.
    """
    # Single precision up to here, as everybody has it: which cell a pixel on an edge falls into depends on it.
    share_a = (uv_a.astype(np.float32) / np.array(size_a_px, np.float32)).astype(np.float32)
    share_b = (uv_b.astype(np.float32) / np.array(size_b_px, np.float32)).astype(np.float32)
    block_a = _blocks(cells)
    best, n_best = np.zeros(len(uv_a), np.bool_), 0
    for ratio in ZOOMS if zoom else ZOOMS[:1]:
        side_b = max(1, int(cells * ratio))
        block_b = _blocks(side_b)
        tables = [_table(share_a, share_b, shift, cells, side_b) for shift in _SHIFTS]
        for eighths in range(8 if rotation else 1):
            block_turned = block_b[:, _turn(eighths)]
            supported = np.zeros(len(uv_a), np.bool_)
            for table in tables:
                supported[_supported(table, block_a, block_turned, threshold)] = True
            if (n := int(supported.sum())) > n_best:
                best, n_best = supported, n
    return best


def match_by_motion(
    frontend: Frontend,
    a: Features,
    b: Features,
    *,
    rotation: bool = False,
    zoom: bool = False,
    threshold: float = THRESHOLD,
) -> Matches:
    """Match wide: nearest neighbours either way, without a ratio test, sorted out by their motion, then one to one.

    A pair needs the support of one direction and to be the best of those that have it, for both of its features: so the
    matches of b with a are those of a with b.

    - `frontend`: one that offers `NearestSearch`.
    - `a`, `b`: of images of one size, or parts of them. The grid spans both images' features.
    - `rotation`, `zoom`, `threshold`: as for `supported_matches`.

    Returns Matches: rows of a, ascending; rows of b.

    Raises `ConfigError`: the front end has no search for nearest neighbours.
    """
    search = nearest_search(frontend)
    if len(a) == 0 or len(b) == 0:
        return NO_MATCHES
    to_b, to_a = search.nearest(a, b), search.nearest(b, a)
    width, height = np.maximum(a.uv_px.max(axis=0), b.uv_px.max(axis=0)) + 1.0
    supported = partial(_supported_nearest, size_px=(width, height), rotation=rotation, zoom=zoom, threshold=threshold)
    there, back = supported(a, b, to_b), supported(b, a, to_a)
    pairs = np.unique(np.concatenate([np.stack([there, to_b[there]], 1), np.stack([to_a[back], back], 1)]), axis=0)
    distance = frontend.distance(a.descriptors[pairs[:, 0]], b.descriptors[pairs[:, 1]])
    near = distance <= frontend.max_distance  # where a match ends is a guide, as in a guided search
    pairs, distance = pairs[near], distance[near]
    best_of_a = best_per_group(pairs[:, 0], distance, len(a))
    best_of_b = best_per_group(pairs[:, 1], distance, len(b))
    chosen = np.intersect1d(best_of_a, best_of_b, assume_unique=True)
    return Matches(pairs[chosen], distance[chosen])


def nearest_search(frontend: Frontend) -> NearestSearch:
    """Return the front end as one that finds nearest neighbours; raises `ConfigError` if it does not."""
    if not isinstance(frontend, NearestSearch):
        raise ConfigError(
            f"gms takes a front end with binary descriptors, as orb, which '{frontend.name}' is not; choose ratio",
            ("initialiser", "matching"),
        )
    return frontend


def _supported_nearest(
    a: Features,
    b: Features,
    nearest: IntArray,
    size_px: tuple[float, float],
    *,
    rotation: bool,
    zoom: bool,
    threshold: float,
) -> IntArray:
    """Rows of a whose nearest of b moves as its neighbours do."""
    cells = int(np.clip(np.sqrt(len(a) / MIN_PER_CELL), 1, CELLS))
    # What a rolling shutter shifted may lie beyond the rim, once that is taken out: it counts to the cell there.
    uv_a, uv_b = (np.clip(uv, 0.0, np.array(size_px) - 1.0) for uv in (a.uv_px, b.uv_px[nearest]))
    return np.flatnonzero(
        supported_matches(uv_a, uv_b, size_px, size_px, rotation=rotation, zoom=zoom, threshold=threshold, cells=cells)
    )


def _table(
    share_a: NDArray[np.float32], share_b: NDArray[np.float32], shift: tuple[float, float], side_a: int, side_b: int
) -> _Table:
    """Count the matches from cell to cell under one displacement of the first grid."""
    place_a = np.floor(np.asarray(share_a * np.float32(side_a), np.float64) + shift).astype(np.int64)
    inside = (place_a < side_a).all(axis=1)  # the displacement pushes half a cell out of the grid
    match = np.flatnonzero(inside)
    cell_a = place_a[match] @ np.array([1, side_a])
    cell_b = np.floor(share_b[match] * np.float32(side_b)).astype(np.int64) @ np.array([1, side_b])
    pair, count = np.unique(cell_a * side_b**2 + cell_b, return_counts=True)
    counts = np.zeros((side_a**2, side_b**2), np.int32)
    counts.reshape(-1)[pair] = count
    pair_a, pair_b = np.divmod(pair, side_b**2)
    favourite = best_per_group(pair_a, -count.astype(np.float64), side_a**2)
    n_a = np.bincount(cell_a, minlength=side_a**2)
    return _Table(match, cell_a, cell_b, counts, n_a, pair_a[favourite], pair_b[favourite])


def _supported(table: _Table, block_a: IntArray, block_b: IntArray, threshold: float) -> IntArray:
    """Return the matches whose pair of cells has the support of the blocks about the two."""
    around_a, around_b = block_a[table.occupied], block_b[table.favourite]
    there = (around_a >= 0) & (around_b >= 0)
    score = np.where(there, table.counts[around_a, around_b], 0).sum(axis=1)
    n_mean = np.where(there, table.n_a[around_a], 0).sum(axis=1) / there.sum(axis=1)
    stands = np.full(len(table.n_a), -1)
    kept = score >= threshold * np.sqrt(n_mean)
    stands[table.occupied[kept]] = table.favourite[kept]
    matches: IntArray = table.match[stands[table.cell_a] == table.cell_b]
    return matches


def _blocks(side: int) -> IntArray:
    """The 3 x 3 block about each cell of a grid, row by row, (side^2, 9); -1 outside the grid."""
    row, column = np.divmod(np.arange(side**2), side)
    step_row, step_column = np.divmod(np.arange(9), 3)
    rows, columns = row[:, None] + step_row - 1, column[:, None] + step_column - 1
    inside = (rows >= 0) & (rows < side) & (columns >= 0) & (columns < side)
    return np.where(inside, rows * side + columns, -1)


def _turn(eighths: int) -> IntArray:
    """Which cell of a block stands for each when the second image is turned by so many eighths, (9,)."""
    order = np.arange(9)
    order[_RING] = np.roll(_RING, eighths)
    return order
