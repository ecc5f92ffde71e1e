"""Features of buffered images: found once, as long as the image lives and memory allows."""

from __future__ import annotations

import gc
import threading

import numpy as np
import pytest
from numpy.typing import NDArray

from dualslam.core.grey_image import GreyImage
from dualslam.core.types import Features
from dualslam.frontends.features import image_features
from dualslam.frontends.features.image_features import ImageFeatures
from dualslam.frontends.features.orb import OrbFrontend
from dualslam.testing.waiting import wait_until
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
    features, images = ImageFeatures(frontend, 0), [some_image(seed) for seed in range(3)]
    first = [features.of(image) for image in images]
    again = [features.of(image) for image in reversed(images)]
    assert frontend.n_calls == 3
    assert all(a is b for a, b in zip(first, reversed(again), strict=True))
    assert (first[1].uv_px == OrbFrontend(100).extract(images[1].pixels()).uv_px).all()


def test_what_was_not_used_for_longest_makes_room(monkeypatch: pytest.MonkeyPatch) -> None:
    frontend = CountingFrontend(100)
    features, images = ImageFeatures(frontend, 0), [some_image(seed) for seed in range(3)]
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
    features = ImageFeatures(frontend, 0)
    features.of(some_image(0))
    gc.collect()
    features.of(some_image(0))
    assert frontend.n_calls == 2
    assert len(features) == 0


class Gate(OrbFrontend):
    """Looks at an image when it may."""

    def __init__(self) -> None:
        super().__init__(100)
        self.may = threading.Event()
        self.seen: list[bytes] = []
        self.threads: set[str] = set()

    def extract(self, image: NDArray[np.uint8]) -> Features:
        assert self.may.wait(60)
        self.seen.append(image.tobytes())
        self.threads.add(threading.current_thread().name)
        return super().extract(image)


def test_what_is_foreseen_is_found_meanwhile_and_once() -> None:
    frontend, images = Gate(), [some_image(seed) for seed in range(3)]
    features = ImageFeatures(frontend, 1)
    features.prefetch(images)  # keeps nobody waiting
    features.prefetch(images)
    assert not frontend.seen
    frontend.may.set()
    found = [features.of(image) for image in images]
    assert frontend.seen == [image.data for image in images]
    assert all(
        (f.uv_px == OrbFrontend(100).extract(i.pixels()).uv_px).all() for f, i in zip(found, images, strict=True)
    )
    assert not {name for name in frontend.threads if not name.startswith("dualslam-features")}


def test_what_was_foreseen_in_vain_keeps_nobody_waiting() -> None:
    frontend, images = Gate(), [some_image(seed) for seed in range(5)]
    features = ImageFeatures(frontend, 1)
    features.prefetch(images[:4])
    features.prefetch(images[2:3])
    frontend.may.set()
    features.of(images[4])
    assert images[4].data in frontend.seen
    # The thread may have had the first one in hand: the others, that nobody wants now, it does not look at.
    assert not {images[1].data, images[3].data} & set(frontend.seen)


def test_what_was_found_in_vain_is_kept_for_later() -> None:
    frontend, images = Gate(), [some_image(seed) for seed in range(2)]
    frontend.may.set()
    features = ImageFeatures(frontend, 1)
    features.prefetch(images[:1])
    features.of(images[0])
    features.prefetch(images[1:])
    wait_until(features._begun[images[1]].done)
    features.prefetch([])
    assert len(features) == 2
    features.of(images[1])
    assert len(frontend.seen) == 2


def test_a_front_end_that_raises_does_so_where_the_features_are_wanted() -> None:
    class Broken(OrbFrontend):
        def extract(self, image: NDArray[np.uint8]) -> Features:
            raise ValueError("no such image")

    features, image = ImageFeatures(Broken(100), 1), some_image(0)
    features.prefetch([image])
    with pytest.raises(ValueError, match="no such image"):
        features.of(image)
