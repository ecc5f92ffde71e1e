"""Another front end's features of buffered images, each found once.

Attempts at a recovery walk the same frames one after the other, and so does a recovery that is tried again: finding
SIFT features anew each time was more than half of what walks cost that come to nothing.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

from dualslam.core.grey_image import GreyImage
from dualslam.core.interfaces import Frontend
from dualslam.core.types import Features

MAX_BYTES = 48 * 2**20
"""About 120 images of 2000 SIFT features: what a walk sees that ends in a gap. One that gets farther needs no other."""


class ImageFeatures:
    """Features of images, as long as somebody holds these, and up to `MAX_BYTES`: then the one goes first that was
    not used for longest.

    Parameters
    ----------
    frontend : Frontend
    """

    def __init__(self, frontend: Frontend) -> None:
        self.frontend = frontend
        self._known: WeakKeyDictionary[GreyImage, Features] = WeakKeyDictionary()  # the last used one stands last

    def of(self, image: GreyImage) -> Features:
        """Return the features of an image, in its own pixels."""
        features = self._known.pop(image, None)
        if features is None:
            features = self.frontend.extract(image.pixels())
        self._known[image] = features
        self._make_room()
        return features

    def _make_room(self) -> None:
        nbytes = sum(features.nbytes for features in self._known.values())
        for image, features in list(self._known.items())[:-1]:
            if nbytes <= MAX_BYTES:
                return
            del self._known[image]
            nbytes -= features.nbytes

    def __len__(self) -> int:
        """Images whose features are known."""
        return len(self._known)
