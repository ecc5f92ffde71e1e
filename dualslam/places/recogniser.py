"""Interface of place recognition."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from dualslam.core.types import Features
from dualslam.map.submap import Submap


@dataclass(frozen=True, slots=True)
class PlaceCandidate:
    """A keyframe that may show what an image shows, by descriptors alone."""

    submap_id: int
    keyframe_id: int
    n_votes: int  # features of the image of which a landmark that the keyframe sees is among the nearest


class PlaceRecogniser(Protocol):
    """Remembers landmarks by their descriptors, and says which keyframes an image resembles.

    It proposes and proves nothing: what it finds goes through `dualslam.places.verification`. The same calls in the
    same order give the same candidates.
    """

    @property
    def nbytes(self) -> int:
        """Memory of the index, about."""
        ...

    def take_in(self, submap: Submap, n_newest_left_out: int = 0, at_most: int | None = None) -> int:
        """Add the landmarks that a submap has gained since the last call; return how many.

        `n_newest_left_out`: keyframes, by insertion, whose own new landmarks have yet to prove themselves. `at_most`:
        the oldest so many of them; the others are left to later calls.
        """
        ...

    def query(
        self,
        features: Features,
        submaps: Mapping[int, Submap],
        may_be: Callable[[int, int], bool] = lambda submap_id, keyframe_id: True,
        at_most: int = 3,
    ) -> list[PlaceCandidate]:
        """Return the keyframes that an image resembles most, best first, each of another place.

        - `features`: of the image.
        - `submaps`: the current submaps of the index: culled and merged landmarks are followed there.
        - `may_be`: whether a keyframe (submap id, keyframe id) may be returned; called for keyframes with votes only.
        """
        ...
