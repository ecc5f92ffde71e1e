"""What a search for an unknown focal length has found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True)
class FocalSearch:
    """What was found.

    Attributes
    ----------
    focal_px, low_px, high_px : float
        The best, and between what it is likely to lie.
    width_px : int
    n_pairs : int
        Of frames, that had an answer.
    """

    focal_px: float
    low_px: float
    high_px: float
    width_px: int
    n_pairs: int

    @property
    def fov_deg(self) -> float:
        """Horizontal field of view."""
        return self._fov_deg(self.focal_px)

    @property
    def fov_range_deg(self) -> tuple[float, float]:
        """The field of view's range: the smallest belongs to the largest focal length."""
        return self._fov_deg(self.high_px), self._fov_deg(self.low_px)

    def _fov_deg(self, focal_px: float) -> float:
        return float(np.degrees(2.0 * np.arctan(0.5 * self.width_px / focal_px)))

    def as_dict(self) -> dict[str, Any]:
        """Return it as ``summary.json`` has it."""
        low, high = self.fov_range_deg
        return {
            "focal_px": self.focal_px,
            "focal_range_px": [self.low_px, self.high_px],
            "fov_deg": self.fov_deg,
            "fov_range_deg": [low, high],
            "pairs": self.n_pairs,
        }
