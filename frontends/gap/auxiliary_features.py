"""Where the features come from by which a walk is posed that the live front end does not pose by itself."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

from dualslam.core.camera.base import Camera
from dualslam.core.camera.rectification import rectify
from dualslam.core.interfaces import Frontend
from dualslam.core.types import Failure, FailureReason, Features, View
from dualslam.frontends.features.image_features import ImageFeatures
from dualslam.frontends.tracking.row_shifts import correct_shutter


class AuxiliaryFeatures(Protocol):
    """A front end's rectified features of views."""

    def of(self, view: View) -> Features | Failure:
        """Return the features of a view; a failure where they cannot be found any more."""
        ...

    def prefetch(self, views: Iterable[View]) -> None:
        """Say which views will be asked for next, in this order: their features may be found beforehand."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Auxiliary:
    """A front end that poses frames, and where its features come from."""

    frontend: Frontend
    features: AuxiliaryFeatures


class OwnFeatures:
    """Those that the live front end has found: it is its own auxiliary front end. Implements `AuxiliaryFeatures`."""

    def of(self, view: View) -> Features | Failure:
        """Return the view's own features."""
        return view.features

    def prefetch(self, views: Iterable[View]) -> None:
        """Do nothing: they are there."""


class BufferedFeatures:
    """Those that another front end finds in the buffered images. Implements `AuxiliaryFeatures`.

    `model_sigma_px`: see `CameraConfig.model_sigma_px`.
    """

    def __init__(self, images: ImageFeatures, model_sigma_px: float, camera: Camera) -> None:
        self._images = images
        self._model_sigma_px = model_sigma_px
        self._camera = camera

    def of(self, view: View) -> Features | Failure:
        """Return the features of a view; a failure where its image is gone."""
        if view.image is None:
            return Failure(FailureReason.UNREADABLE, "its image is no longer buffered")
        features = rectify(self._images.of(view.image), self._camera, self._model_sigma_px)
        return features if view.turn_rad is None else correct_shutter(features, self._camera, view.turn_rad)

    def prefetch(self, views: Iterable[View]) -> None:
        """Say which views will be asked for next."""
        self._images.prefetch(view.image for view in views if view.image is not None)
