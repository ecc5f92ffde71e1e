"""Features of buffered images: found once, as long as the image lives and memory allows."""

from __future__ import annotations

import gc

import numpy as np
import pytest
from numpy.typing import NDArray

from dualslam.core.grey_image import GreyImage
from dualslam.core.types import Features
from frontends import image_features
from frontends.image_features import ImageFeatures
from frontends.orb import OrbFrontend
from tests.frontends.conftest import textured


class CountingFrontend(OrbFrontend):
    n_calls = 0

    def extract(self, image: NDArray[np.uint8]) -> Features:
        self.n_calls += 1
        return super().extract(image)


def some_image(seed: int) -> GreyImage:
    return GreyImage.of(textured(160, 200, seed))


def test_an_image_is_looked_at_once() -> None:
    frontend = CountingFrontend(100)
    features, images = ImageFeatures(frontend), [some_image(seed) for seed in range(3)]
    first = [features.of(image) for image in images]
    again = [features.of(image) for image in reversed(images)]
    assert frontend.n_calls == 3
    assert all(a is b for a, b in zip(first, reversed(again), strict=True))
    assert (first[1].uv_px == OrbFrontend(100).extract(images[1].pixels()).uv_px).all()


def test_what_was_not_used_for_longest_makes_room(monkeypatch: pytest.MonkeyPatch) -> None:
    frontend = CountingFrontend(100)
    features, images = ImageFeatures(frontend), [some_image(seed) for seed in range(3)]
    monkeypatch.setattr(image_features, "MAX_BYTES", 2.5 * frontend.extract(images[0].pixels()).nbytes)
    for image in (images[0], images[1], images[0], images[2]):
        features.of(image)
    frontend.n_calls = 0
    features.of(images[0])
    features.of(images[2])
    assert frontend.n_calls == 0
    features.of(images[1])
    assert frontend.n_calls == 1


def test_features_go_with_their_image() -> None:
    frontend = CountingFrontend(100)
    features = ImageFeatures(frontend)
    features.of(some_image(0))
    gc.collect()
    features.of(some_image(0))
    assert frontend.n_calls == 2
    assert len(features) == 0
