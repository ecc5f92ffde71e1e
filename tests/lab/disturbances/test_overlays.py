"""Overlays: what stands still in the image."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.core.config.corruption import Corruption, CorruptionKind
from dualslam.lab.disturbances import hidden_by
from dualslam.lab.disturbances.images import corrupt_image
from dualslam.lab.disturbances.overlays import OVERLAYS, overlay_mask

WIDTH, HEIGHT = 320, 240


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)


@pytest.mark.parametrize("kind", OVERLAYS)
def test_an_overlay_hides_its_share_and_nothing_else(kind: CorruptionKind) -> None:
    mask = overlay_mask(Corruption(kind=kind), (WIDTH, HEIGHT))
    assert mask.mean() == pytest.approx(kind.default, abs=0.005)
    for index in (0, 5):
        image = noise(index)
        hidden = corrupt_image(image, Corruption(kind=kind), index)
        assert (hidden[~mask] == image[~mask]).all()
        assert (hidden[mask] != image[mask]).mean() > 0.95


@pytest.mark.parametrize("kind", OVERLAYS)
def test_an_overlay_stands_still_but_for_a_clocks_digits(kind: CorruptionKind) -> None:
    overlay = Corruption(kind=kind)
    mask = overlay_mask(overlay, (WIDTH, HEIGHT))
    first, next_frame, later = (corrupt_image(noise(i), overlay, i)[mask] for i in (0, 1, 25))
    assert (first == next_frame).all()
    changed = (first != later).mean()
    assert 0.01 < changed < 0.2 if kind is CorruptionKind.CLOCK else changed == 0


def test_several_overlays_hide_what_any_of_them_hides() -> None:
    cab, clock, blur = (Corruption.model_validate({"kind": kind}) for kind in ("cab", "clock", "blur"))
    hidden = hidden_by([cab, clock, blur], (WIDTH, HEIGHT))
    assert (hidden == overlay_mask(cab, (WIDTH, HEIGHT)) | overlay_mask(clock, (WIDTH, HEIGHT))).all()
    assert not hidden_by([blur], (WIDTH, HEIGHT)).any()
