"""Patches: a point is found where an image was moved to, to a fraction of a pixel, and nowhere else."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dualslam.core.types import FloatArray
from dualslam.frontends.direct.warp import build_pyramid
from dualslam.frontends.gap.refinding import match_patches

SIZE = 240
PLACE_TOLERANCE_PX = 0.3
RADIUS_PX = 5.0


def texture(seed: int = 0) -> NDArray[np.uint8]:
    """Make blobs of several sizes, so that something is left at half the size."""
    rng = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(rng.normal(0, 1, (SIZE, SIZE)), (0, 0), sigma) * sigma for sigma in (1.0, 2.0, 4.0)]
    return np.clip(128 + 60 * sum(layers), 0, 255).astype(np.uint8)


def moved(image: NDArray[np.uint8], J: FloatArray, uv: FloatArray) -> tuple[NDArray[np.uint8], FloatArray]:
    """Return the image moved by a linear map about its middle, and where places of it have come to lie."""
    middle = np.full(2, (SIZE - 1) / 2)
    t = middle - J @ middle
    zoom = np.sqrt(np.linalg.det(J))
    source = cv2.GaussianBlur(image, (0, 0), 0.5 / zoom) if zoom < 0.9 else image
    warped = cv2.warpAffine(source, np.column_stack([J, t]), (SIZE, SIZE), flags=cv2.INTER_LINEAR, borderValue=128)
    return np.asarray(warped, np.uint8), uv @ J.T + t


def similarity(zoom: float, degrees: float) -> FloatArray:
    """Make a linear map."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return zoom * np.array([[c, -s], [s, c]])


def places() -> FloatArray:
    """Return a grid of places near the middle."""
    grid = np.linspace(85, 155, 8)
    return np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize(("zoom", "degrees"), [(1.0, 0.0), (0.5, 0.0), (0.4, 20.0), (2.0, -10.0)])
def test_points_are_found_at_another_size_and_turn(zoom: float, degrees: float) -> None:
    image, uv, J = texture(), places(), similarity(zoom, degrees)
    other, truth = moved(image, J, uv)
    inside = ((truth > 20) & (truth < SIZE - 20)).all(axis=1)
    uv, truth = uv[inside], truth[inside]
    off = np.random.default_rng(1).uniform(-3, 3, truth.shape) * max(zoom, 1.0)
    found = match_patches(
        build_pyramid(image), build_pyramid(other), uv, truth + off, np.tile(J, (len(uv), 1, 1)), RADIUS_PX
    )
    error = np.linalg.norm(found.uv_px - truth[found.row], axis=1)
    assert len(found.row) > 0.8 * len(uv)
    assert np.median(error) < PLACE_TOLERANCE_PX * max(zoom, 1.0)
    assert (error < max(zoom, 1.0)).mean() > 0.95
    np.testing.assert_allclose(found.spacing_px, max(zoom, 1.0))


def test_nothing_is_found_that_is_not_there() -> None:
    uv = places()
    J = np.tile(np.eye(2), (len(uv), 1, 1))
    levels = build_pyramid(texture())
    assert len(match_patches(levels, build_pyramid(texture(seed=1)), uv, uv, J, RADIUS_PX).row) == 0
    assert len(match_patches(levels, levels, uv, uv + 30.0, J, RADIUS_PX).row) == 0


def test_flat_and_repeated_patches_are_left_out() -> None:
    uv = places()
    J = np.tile(np.eye(2), (len(uv), 1, 1))
    flat = build_pyramid(np.full((SIZE, SIZE), 90, np.uint8))
    assert len(match_patches(flat, flat, uv, uv, J, RADIUS_PX).row) == 0
    x, y = np.meshgrid(np.arange(SIZE), np.arange(SIZE))
    wallpaper = build_pyramid(
        np.asarray(128 + 50 * np.sin(2 * np.pi * x / 4) + 50 * np.sin(2 * np.pi * y / 4), np.uint8)
    )
    assert len(match_patches(wallpaper, wallpaper, uv, uv, J, RADIUS_PX).row) == 0
