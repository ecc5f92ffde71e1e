"""Images of the latest keyframes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from dualslam.core.grey_image import GreyImage
from dualslam.core.types import FloatArray, View

RIM_KEYFRAMES = 6
"""Keyframes before a gap whose landmarks are looked for beyond it."""
KEPT_IMAGES = 2 * RIM_KEYFRAMES
"""Those nearest in time to the latest keyframe: twice the rim, since not each keyframe is there to stay."""


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeImage:
    """An image, and the turn during its readout that was taken out of its features (None: nothing was)."""

    image: GreyImage
    turn_rad: FloatArray | None


class KeyframeImages:
    """Knows the images of a front end's latest keyframes, by the keyframes' ids."""

    def __init__(self) -> None:
        self._kept: dict[int, KeyframeImage] = {}

    def __contains__(self, keyframe_id: object) -> bool:
        return keyframe_id in self._kept

    def __getitem__(self, keyframe_id: int) -> KeyframeImage:
        return self._kept[keyframe_id]

    def remember(self, view: View) -> None:
        """Keep the image of a keyframe."""
        if view.image is None:
            return
        self._kept[view.index] = KeyframeImage(view.image, view.turn_rad)
        for index in sorted(self._kept, key=lambda i: abs(i - view.index))[KEPT_IMAGES:]:
            del self._kept[index]

    def forget(self, keyframe_ids: Iterable[int]) -> None:
        """Forget the images of keyframes whose features are not where they were when they were remembered."""
        for k in keyframe_ids:
            self._kept.pop(k, None)
