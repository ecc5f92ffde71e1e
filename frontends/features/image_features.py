"""Another front end's features of buffered images, each found once, and beforehand where they can be prefetched.

Attempts at a recovery visit the same frames one after the other, and the next images are known. `features_found`
makes features of points that a search in the image has found.
"""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from weakref import WeakKeyDictionary

import numpy as np

from dualslam.core.camera.base import Camera, rectified_sigma
from dualslam.core.grey_image import GreyImage
from dualslam.core.interfaces import Frontend
from dualslam.core.types import Features, FloatArray, IntArray
from dualslam.frontends.features.images import features_of
from dualslam.frontends.tracking.turning import straighten

MAX_BYTES = 48 * 2**20
"""About 120 images of 2000 SIFT features: what a walk sees that ends in a gap. One that gets farther needs no other."""


class ImageFeatures:
    """Features of images, as long as somebody holds these, and up to `MAX_BYTES`, the least recently used going first.

    `n_threads`: that look at prefetched images; with none they are looked at when they are wanted.
    """

    def __init__(self, frontend: Frontend, n_threads: int) -> None:
        self.frontend = frontend
        self._known: WeakKeyDictionary[GreyImage, Features] = WeakKeyDictionary()  # the last used one stands last
        self._begun: WeakKeyDictionary[GreyImage, Future[Features]] = WeakKeyDictionary()
        self._threads = ThreadPoolExecutor(n_threads, "dualslam-features") if n_threads else None

    def of(self, image: GreyImage) -> Features:
        """Return the features of an image, in its own pixels."""
        features = self._known.pop(image, None)
        if features is None:
            begun = self._begun.pop(image, None)
            if begun is None:  # what was prefetched did not come: it shall keep nobody waiting
                self.prefetch([])
            features = self._look_at(image) if begun is None else begun.result()
        self._known[image] = features
        self._make_room()
        return features

    def prefetch(self, images: Iterable[GreyImage]) -> None:
        """Say which images will be asked for next, in this order: the threads look at them, and at no others."""
        if self._threads is None:
            return
        wanted = list(images)
        for image, features in list(self._begun.items()):
            if image not in wanted and (features.cancel() or features.done()):
                del self._begun[image]
                if not features.cancelled() and features.exception() is None:
                    self._known[image] = features.result()
        for image in wanted:
            if image not in self._known and image not in self._begun:
                self._begun[image] = self._threads.submit(self._look_at, image)

    def _look_at(self, image: GreyImage) -> Features:
        return features_of(self.frontend, image.pixels())

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


def features_found(
    of: Features,
    uv_px: FloatArray,
    sigma_px: FloatArray,
    zoom: FloatArray,
    turn_rad: FloatArray,
    frontend: Frontend,
    camera: Camera,
    model_sigma_px: float,
    readout_turn_rad: FloatArray | None,
) -> tuple[IntArray, Features]:
    """Return which of N features were found at pixels that the camera can rectify, and these as features there.

    - `of`: of another view: the same landmarks.
    - `uv_px` (N, 2): where the new image shows them, as read.
    - `sigma_px`, `zoom`, `turn_rad` (N,): noise of each coordinate; by how much larger the image shows them, and turned
      by which angle.
    - `camera`: the one that rectifies now.
    - `model_sigma_px`: error of its model, see `CameraConfig.model_sigma_px`.
    - `readout_turn_rad` (3,) or None: rotation during the readout that is taken out of the new view's features.
    """
    if readout_turn_rad is not None:
        uv_px = straighten(uv_px, camera, readout_turn_rad)
    uv_rect, magnification = camera.rectify(uv_px)
    row = np.flatnonzero(np.isfinite(uv_rect).all(axis=1) & np.isfinite(magnification))
    of = of.take(row)
    scale = np.maximum(of.scale * zoom[row], 1.0)
    octave = np.rint(np.log(scale) / np.log(frontend.scale_factor)).astype(np.int64)
    octave = np.minimum(octave, frontend.n_octaves - 1)
    sigma = rectified_sigma(sigma_px[row], magnification[row], model_sigma_px)
    angle = of.angle_rad + turn_rad[row]
    return row, Features(uv_px[row], uv_rect[row], sigma, scale, octave, angle, of.descriptors)
