"""A smooth bending of a submap: one similarity per knot along its frames, interpolated between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dualslam.core.geometry import sim3
from dualslam.core.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Warp:
    """Similarities that act from the left, in the submap's frame: what belongs to frame `i` goes by ``S(i) @ p``.

    Between two knots the similarity runs along the one-parameter subgroup that joins theirs; before the first and
    after the last knot it stays.
    """

    index: IntArray  # (K,): frames of the knots, ascending, at least one
    S: FloatArray  # (K, 4, 4)

    def at(self, index: ArrayLike) -> FloatArray:
        """Return (N, 4, 4) similarities of frames."""
        asked = np.clip(np.asarray(index, np.int64).reshape(-1), self.index[0], self.index[-1])
        i, of_each = np.unique(asked, return_inverse=True)  # the landmarks of a keyframe all ask for the same
        before = np.searchsorted(self.index, i, side="right") - 1
        after = np.minimum(before + 1, len(self.index) - 1)
        start, width = self.index[before], self.index[after] - self.index[before]
        found = self.S[before].copy()
        between = np.flatnonzero((i > start) & (width > 0))
        if len(between):
            a, b = before[between], after[between]
            share = (i[between] - start[between]) / width[between]
            gap = sim3.log(sim3.inverse(self.S[a]) @ self.S[b])
            found[between] = self.S[a] @ sim3.exp(share[:, None] * gap)
        return found[of_each]

    def after(self, earlier: Warp) -> Warp:
        """Return this bending of what `earlier` has bent already, with the knots of both."""
        index = np.union1d(self.index, earlier.index)
        return Warp(index, self.at(index) @ earlier.at(index))
