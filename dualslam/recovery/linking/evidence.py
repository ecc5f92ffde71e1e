"""What reverse tracking decides by when a link is not made."""

from __future__ import annotations

from dataclasses import dataclass

from dualslam.core.types import Failure


@dataclass(frozen=True, slots=True)
class LinkRefusal(Failure):
    """A link that is not made. `Failure.numbers` are for the event log alone.

    Attributes
    ----------
    torn_at : int or None
        The keyframe before which the new map is torn.
    walk_sigma : float
        Relative sigma of the scale that reverse tracking has handed on; 0 where another gate came first.
    """

    torn_at: int | None = None
    walk_sigma: float = 0.0
