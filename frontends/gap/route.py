"""The frames that reverse tracking will come to, and which of them are worth a look."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

from dualslam.core.types import Failure, FailureReason, View

MIN_CONTRAST = 4.0
"""Standard deviation of the greys: sensors have a noise of 1 to 3, and blank images have that alone."""
N_PREFETCHED = 1
"""Usable frames beyond the one at hand: a gap relocalisation takes two."""


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """Start of a walk, and the frames on its way."""

    own: Sequence[View]  # of the submap's own keyframes
    ahead: Sequence[View]  # in the order in which they will be given

    def usable_after(self, view: View, min_features: int) -> Iterator[View]:
        """Yield the next frames after one in which features can be found."""
        place = next((n for n, ahead in enumerate(self.ahead) if ahead.index == view.index), len(self.ahead))
        usable = (after for after in self.ahead[place + 1 :] if find_lack(after, min_features) is None)
        return islice(usable, N_PREFETCHED)


def find_lack(view: View, min_features: int) -> Failure | None:
    """Return why a frame is not worth a look; None if it is."""
    if len(view.features) < min_features:
        return Failure(FailureReason.NO_TEXTURE, f"{len(view.features)} features in the image")
    if view.image is not None and view.image.pixels()[::8, ::8].std() < MIN_CONTRAST:
        return Failure(FailureReason.NO_TEXTURE, "a blank image")
    return None
