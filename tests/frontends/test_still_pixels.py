"""What stands still in the image is found, and nothing else is."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from dualslam.core.config.corruption import Corruption
from dualslam.core.types import BoolArray
from dualslam.frontends.still_pixels import StillPixels, U8Image
from dualslam.lab.disturbances import hidden_by
from dualslam.lab.disturbances.images import corrupt_image

WIDTH, HEIGHT = 320, 240
STEP_S = 0.2
FOUND_S = 3.0


@pytest.fixture(scope="module")
def wall() -> U8Image:
    """A textured plane, larger than the image."""
    rng = np.random.default_rng(4)
    total = np.zeros((700, 900), np.float32)
    for cell in (20, 7, 4):
        blocks = rng.uniform(0, 255, (700 // cell + 1, 900 // cell + 1)).astype(np.float32)
        total += cv2.resize(blocks, (900, 700), interpolation=cv2.INTER_LINEAR) / 3
    return np.clip(total, 0, 255).astype(np.uint8)


def seen(wall: U8Image, i: int, speed_px: float = 9.0) -> U8Image:
    """Return what a camera that slides along the wall sees at its i-th look, with a sensor's noise."""
    at = np.float32([[1, 0, -20 - speed_px * i], [0, 1, -200 + 30 * np.sin(0.3 * i)]])
    image = cv2.warpAffine(wall, at, (WIDTH, HEIGHT)).astype(np.float32)
    image += np.random.default_rng(i).normal(0, 1.5, image.shape)
    return np.clip(image, 0, 255).astype(np.uint8)


def overlap(found: BoolArray | None, true: BoolArray) -> float:
    return 0.0 if found is None else float((found & true).sum() / (found | true).sum())


OVERLAYS = [
    ("cab", 0.28, 0.9),
    ("cab", 0.48, 0.9),
    ("bars", 0.6, 0.9),
    ("bars", 0.7, 0.9),
    ("bonnet", 0.15, 0.9),
    ("logo", 0.02, 0.9),
    ("clock", 0.03, 0.65),
]
"""With the overlap of what is found and what is true; half a clock's seconds change in small images."""


@pytest.mark.parametrize(("kind", "share", "least"), OVERLAYS)
def test_an_overlay_is_found_within_three_seconds(wall: U8Image, kind: str, share: float, least: float) -> None:
    overlay = Corruption.model_validate({"kind": kind, "strength": share})
    still = StillPixels((WIDTH, HEIGHT))
    for i in range(round(FOUND_S / STEP_S)):
        still.look(STEP_S * i, corrupt_image(seen(wall, i), overlay, 2 * i))
    assert overlap(still.hidden, hidden_by([overlay], (WIDTH, HEIGHT))) > least
    assert not still.camera_stands


def test_nothing_is_found_or_suspected_where_all_moves(wall: U8Image) -> None:
    still = StillPixels((WIDTH, HEIGHT))
    for i in range(40):
        still.look(STEP_S * i, seen(wall, i))
        assert still.hidden is None
        assert not still.is_suspicious


@pytest.mark.parametrize("kind", ["cab", "bars"])
def test_an_overlay_is_suspected_before_it_is_found(wall: U8Image, kind: str) -> None:
    cab, still = Corruption.model_validate({"kind": kind}), StillPixels((WIDTH, HEIGHT))
    for i in range(15):
        still.look(STEP_S * i, corrupt_image(seen(wall, i), cab, i))
        if i > 0:
            assert still.is_suspicious is (still.hidden is None)
    assert still.hidden is not None


def test_a_suspicion_that_does_not_come_true_ends(wall: U8Image) -> None:
    """A tenth of the image stands still for half of the time."""
    still, n_suspicious = StillPixels((WIDTH, HEIGHT)), 0
    for i in range(40):
        image = seen(wall, i)
        image[:, :32] = seen(wall, i // 2)[:, :32]
        still.look(STEP_S * i, image)
        n_suspicious += still.is_suspicious
    assert still.hidden is None
    assert STEP_S * n_suspicious <= 3.5


def test_distant_scenery_is_no_overlay_for_a_camera_that_is_carried(wall: U8Image) -> None:
    """The upper half is infinitely far, the lower half passes by; the camera sways by a pixel."""
    still = StillPixels((WIDTH, HEIGHT))
    rng = np.random.default_rng(1)
    for i in range(30):
        image = seen(wall, i)
        sway = np.float32([[1, 0, -300 + rng.normal(0, 1)], [0, 1, -300 + rng.normal(0, 1)]])
        image[: HEIGHT // 2] = cv2.warpAffine(wall, sway, (WIDTH, HEIGHT))[: HEIGHT // 2]
        still.look(STEP_S * i, image)
    assert still.hidden is None


def test_a_camera_at_rest_says_nothing(wall: U8Image) -> None:
    still = StillPixels((WIDTH, HEIGHT))
    for i in range(30):
        still.look(STEP_S * i, seen(wall, 3))
    assert still.hidden is None
    assert not still.camera_stands


def test_where_something_passes_a_camera_at_rest_it_is_the_camera_that_stands(wall: U8Image) -> None:
    still = StillPixels((WIDTH, HEIGHT))
    for i in range(30):
        image = seen(wall, 3)
        image[60:180, 90:210] = seen(wall, 10 + i)[60:180, 90:210]
        still.look(STEP_S * i, image)
    assert still.camera_stands
    assert still.hidden is None
    for i in range(30, 40):
        still.look(STEP_S * i, seen(wall, i))
    assert not still.camera_stands
    assert still.hidden is None


def test_what_has_moved_for_long_is_not_hidden_when_the_camera_halts(wall: U8Image) -> None:
    """Traffic before a car that waits for four seconds fills most of the image."""
    still = StillPixels((WIDTH, HEIGHT))
    for i in range(60):
        image = seen(wall, i)
        if i >= 40:
            image = seen(wall, 40)
            image[:160] = seen(wall, 2 * i)[:160]
        still.look(STEP_S * i, image)
    assert still.hidden is None


def test_dirt_that_is_wiped_off_is_scene_again(wall: U8Image) -> None:
    logo, still = Corruption.model_validate({"kind": "logo", "strength": 0.05}), StillPixels((WIDTH, HEIGHT))
    for i in range(15):
        still.look(STEP_S * i, corrupt_image(seen(wall, i), logo, i))
    assert still.hidden is not None
    changes = [still.look(STEP_S * i, seen(wall, i)) for i in range(15, 30)]
    assert still.hidden is None
    assert any(changes)


def test_pixels_of_a_known_mask_have_no_vote(wall: U8Image) -> None:
    """A mask of 70 % that stands still would else make the camera the one that stands."""
    bars, still = Corruption.model_validate({"kind": "cab", "strength": 0.7}), StillPixels((WIDTH, HEIGHT))
    masked = hidden_by([bars], (WIDTH, HEIGHT))
    for i in range(20):
        still.look(STEP_S * i, corrupt_image(seen(wall, i), bars, i), masked)
        assert not still.camera_stands
        assert not still.is_suspicious
    assert still.hidden is None


def test_images_are_looked_at_by_their_times(wall: U8Image) -> None:
    """Thirty frames a second give what five do."""
    cab = Corruption.model_validate({"kind": "cab"})
    slow, quick = StillPixels((WIDTH, HEIGHT)), StillPixels((WIDTH, HEIGHT))
    for i in range(12):
        slow.look(STEP_S * i, corrupt_image(seen(wall, i), cab, 0))
        for k in range(6):
            quick.look(STEP_S * (i + k / 6), corrupt_image(seen(wall, i), cab, 0))
    assert slow.hidden is not None
    assert quick.hidden is not None
    assert (slow.hidden == quick.hidden).all()
