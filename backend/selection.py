"""Which of the observations that a graph could bear become its factors: pure numpy, no solver.

An update's cost is that of the cliques which iSAM2 takes apart and puts together again, each landmark one of them. A
part of the observations is chosen, spread over the images, long tracks first. What is left out stays in the submap,
follows the poses (`dualslam.backend.point_refinement`) and is tested for outliers like all others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualslam.backend.observability import take_mask
from dualslam.core.arrays import rank_in_runs
from dualslam.core.noise_model import CELLS_ACROSS, PROOF_VIEWS
from dualslam.core.types import BoolArray, FloatArray, IntArray

_CELLS_A_ROW = 4 * CELLS_ACROSS + 1
"""Up to four times the width: what lies farther out, as a lens may have it, is in the last."""
_N_CELLS = _CELLS_A_ROW**2


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """All rows of a submap's observation table, as the selection looks at them."""

    kf: IntArray  # (R,)
    landmark: IntArray  # (R,)
    uv_px: FloatArray  # (R, 2)
    width_px: float  # of the image, about


def spread_evenly(rank: IntArray, n: IntArray, quota: IntArray) -> BoolArray:
    """Return which of runs of `n` are taken so that `quota` are, evenly spread, the first and the last among them."""
    steps = np.maximum(n - 1, 1)
    hops = np.maximum(np.minimum(quota, n) - 1, 1)
    taken = (rank * hops) // steps != ((rank - 1) * hops) // steps
    return np.asarray((rank == 0) | (taken & (quota > 1)), bool)


def choose_factors(
    candidates: Candidates,
    admitted: BoolArray,
    factors: BoolArray,
    keyframes: IntArray,
    n_landmarks: int,
    per_keyframe: int,
    max_views: int,
    min_views: int,
) -> BoolArray:
    """Return which rows are to be factors.

    A landmark that was chosen stays as long as two of its views are admitted. Keyframes short of `per_keyframe` are
    filled, in the order given: first from chosen landmarks that lack views, then from others, with views spread evenly
    over their track, at last from chosen ones beyond their cap. Each time the least occupied cell of the image comes
    first, and the longest track (in time: the few that bridge a gap are long).

    - `keyframes` (K,).
    - `admitted` (R,) bool: rows that the graph can bear.
    - `factors` (R,) bool: rows that are factors now.
    - `per_keyframe`, `max_views`: factors that a keyframe should have, about, and views of a landmark.
    - `min_views`: views that a landmark must bring.
    """
    kf, landmark = candidates.kf, candidates.landmark
    chosen = factors & admitted
    views = np.bincount(landmark[chosen], minlength=n_landmarks)
    _top_up(candidates, admitted, chosen, factors, views, min_views)
    # Only what keyframes that are short see is looked at closer: the tables are long.
    n_known = np.bincount(landmark[admitted], minlength=n_landmarks)
    free = admitted & ~chosen & ((views > 0) | (n_known >= min_views))[landmark]
    if min(per_keyframe, max_views) >= len(kf):
        return chosen | free  # nothing is ever full
    size = max(int(kf.max(initial=-1)), int(keyframes.max(initial=-1))) + 1
    has = np.bincount(kf[chosen], minlength=size)[keyframes]
    short = keyframes[(has < per_keyframe) & (np.bincount(kf[free], minlength=size)[keyframes] > 0)]
    if len(short) == 0:
        return chosen
    is_short = take_mask(short, size)
    row, starts, ends = _by_keyframe(np.flatnonzero(free & is_short[kf]), kf, short)
    of_short, firsts, lasts = _by_keyframe(np.flatnonzero(admitted & is_short[kf]), kf, short)
    by_landmark = np.flatnonzero(admitted & take_mask(landmark[row], n_landmarks)[landmark])
    by_landmark = by_landmark[np.lexsort((kf[by_landmark], landmark[by_landmark]))]
    first_of = np.concatenate(([0], np.cumsum(np.bincount(landmark[by_landmark], minlength=n_landmarks))))
    span = _spans(kf[by_landmark], first_of)
    for start, end, first, last in zip(starts, ends, firsts, lasts, strict=True):
        here, all_here = row[start:end], of_short[first:last]
        here = here[~chosen[here]]
        cells = _Cells(candidates, all_here[chosen[all_here]])
        for stage in range(3):
            wanted = per_keyframe - len(cells)
            if wanted <= 0:
                break
            of = landmark[here]
            if stage == 0:
                able = (views[of] > 0) & (views[of] < max_views)
            elif stage == 1:
                able = views[of] == 0
            else:
                able = views[of] > 0
            taken = cells.take(here[able], span[of[able]], wanted)
            chosen[taken] = True
            if stage == 1:
                others = _spread_views(taken, landmark, by_landmark, first_of, max_views)
                others = others[~chosen[others]]
                chosen[others] = True
                taken = np.concatenate((taken, others))
            np.add.at(views, landmark[taken], 1)
            here = here[~chosen[here]]
    return chosen


def _by_keyframe(rows: IntArray, kf: IntArray, keyframes: IntArray) -> tuple[IntArray, list[int], list[int]]:
    """Return rows sorted by keyframe, and where in them those of each of some keyframes begin and end."""
    rows = rows[np.argsort(kf[rows], kind="stable")]
    begin, end = (np.searchsorted(kf[rows], keyframes, side).tolist() for side in ("left", "right"))
    return rows, begin, end


class _Cells:
    """How occupied the cells of one keyframe's image are."""

    def __init__(self, candidates: Candidates, rows: IntArray) -> None:
        self._candidates = candidates
        self._occupied = np.zeros(_N_CELLS, np.int64)
        self._n = 0
        self._add(self._cell(rows))

    def __len__(self) -> int:
        return self._n

    def _cell(self, rows: IntArray) -> IntArray:
        at = np.clip(
            self._candidates.uv_px.take(rows, axis=0) * (CELLS_ACROSS / self._candidates.width_px), 0, 4 * CELLS_ACROSS
        )
        column, row = at.astype(np.int64).T
        return np.asarray(row * _CELLS_A_ROW + column, np.int64)

    def _add(self, cells: IntArray) -> None:
        self._occupied += np.bincount(cells, minlength=_N_CELLS)
        self._n += len(cells)

    def take(self, rows: IntArray, span: IntArray, n: int) -> IntArray:
        """Take up to `n` of the rows: the least occupied cell first, in it the longest track (ties: the older row)."""
        if len(rows) == 0:
            return rows
        cell = self._cell(rows)
        order = np.lexsort((rows, -span, cell))
        level = self._occupied[cell[order]] + rank_in_runs(cell[order])
        first = order[np.lexsort((rows[order], -span[order], level))[:n]]
        self._add(cell[first])
        return rows[first]


def _top_up(
    candidates: Candidates, admitted: BoolArray, chosen: BoolArray, factors: BoolArray, views: IntArray, min_views: int
) -> None:
    """Give landmarks that lost views others in their stead, and drop those that are left with fewer than two."""
    landmark = candidates.landmark
    lost = np.unique(landmark[factors & ~chosen])
    lost = lost[views[lost] < max(min_views, PROOF_VIEWS)]
    if len(lost) == 0:
        return
    mark = np.zeros(len(views), bool)
    mark[lost] = True
    row = np.flatnonzero(admitted & mark[landmark])
    row = row[np.lexsort((candidates.kf[row], landmark[row]))]
    n = np.bincount(landmark[row], minlength=len(views))
    taken = spread_evenly(rank_in_runs(landmark[row]), n[landmark[row]], np.full(len(row), PROOF_VIEWS))
    chosen[row[taken]] = True
    few = mark & (n < 2)
    chosen[few[landmark]] = False
    views[lost] = np.bincount(landmark[chosen], minlength=len(views))[lost]


def _spans(kf: IntArray, first_of: IntArray) -> IntArray:
    """Return each landmark's length of track, in frames; `kf` of its views lie between two entries of `first_of`."""
    n = np.diff(first_of)
    spans = np.zeros(len(n), np.int64)
    seen = n > 0
    spans[seen] = kf[first_of[1:][seen] - 1] - kf[first_of[:-1][seen]]
    return spans


def _spread_views(taken: IntArray, landmark: IntArray, by_landmark: IntArray, first_of: IntArray, n: int) -> IntArray:
    """Return, of the landmarks of some rows, the rows of `n` views each, spread evenly over the track."""
    ids = landmark[taken]
    lengths = first_of[ids + 1] - first_of[ids]
    owner = np.repeat(np.arange(len(ids)), lengths)
    rank = np.arange(len(owner)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    rows = by_landmark[first_of[ids][owner] + rank]
    return np.asarray(rows[spread_evenly(rank, lengths[owner], np.full(len(owner), n))])
