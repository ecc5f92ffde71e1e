"""Subject of the conformance checks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualslam.core.interfaces import Frontend
from dualslam.core.types import Features, FloatArray
from dualslam.frontends.conformance.scene import PrintedPlane
from dualslam.frontends.registry import FrontendFactory

N_FEATURES = 800
FEATURES_ARRAYS = ("uv_px", "uv_rect_px", "sigma_px", "scale", "octave", "angle_rad", "descriptors")


@dataclass(frozen=True, slots=True)
class Subject:
    """The front end under examination, and the scene that it is shown."""

    factory: FrontendFactory  # what the entry point names
    options: Mapping[str, Any] = field(default_factory=dict)  # `frontend.options` to build it with

    def make(self, n_features: int = N_FEATURES) -> Frontend:
        """Build it anew."""
        return self.factory.from_options(n_features, self.options)

    def scene(self, seed: int = 1) -> PrintedPlane:
        """Return a flat scene full of blobs, bars and corners."""
        return _printed(seed)

    def image(self, H_view_scene: FloatArray | None = None, seed: int = 0) -> NDArray[np.uint8]:
        """Photograph that scene (`PrintedPlane.photograph`)."""
        return self.scene().photograph(H_view_scene, seed=seed)


@lru_cache(maxsize=2)
def _printed(seed: int) -> PrintedPlane:
    """The scene of a seed: drawing one takes longer than most checks."""
    return PrintedPlane.printed(seed)


def same_features(a: Features, b: Features) -> bool:
    """Whether two sets of features are equal bit for bit."""
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in FEATURES_ARRAYS)
