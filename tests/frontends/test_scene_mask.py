"""Hidden pixels are painted over, and give no features."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.core.camera.models import PinholeCamera
from dualslam.core.grey_image import GreyImage
from dualslam.core.types import BoolArray, Frame, View
from dualslam.frontends.features.orb import OrbFrontend
from dualslam.frontends.features.sift import SiftFrontend
from dualslam.frontends.frame_reader import view_of
from dualslam.frontends.scene_mask import SUPPORT_PX, Cover, SceneMask
from dualslam.frontends.still_pixels import StillPixels

WIDTH, HEIGHT = 320, 240
CAMERA = PinholeCamera(WIDTH, HEIGHT, 300.0, 300.0, 160.0, 120.0)


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    rng = np.random.default_rng(2)
    return np.kron(rng.integers(0, 256, (HEIGHT // 8, WIDTH // 8)), np.ones((8, 8))).astype(np.uint8)


@pytest.fixture(scope="module")
def hidden() -> BoolArray:
    mask = np.zeros((HEIGHT, WIDTH), np.bool_)
    mask[150:] = mask[:, :70] = True
    return mask


def test_paint_leaves_the_scene_and_no_edges_elsewhere(image: np.ndarray, hidden: BoolArray) -> None:
    painted = Cover.of(hidden).paint(image)
    assert (painted[~hidden] == image[~hidden]).all()
    inner = np.zeros_like(hidden)
    inner[180:] = inner[:, :40] = True
    steps = np.abs(np.diff(painted.astype(int), axis=1))[inner[:, 1:] & inner[:, :-1]]
    assert steps.max() < 25
    assert np.abs(np.diff(image.astype(int), axis=1)).max() > 200
    assert abs(float(painted[hidden].mean()) - float(image[~hidden].mean())) < 20


def test_colour_is_painted_channel_by_channel(image: np.ndarray, hidden: BoolArray) -> None:
    colour = np.dstack([image, 255 - image, image // 2])
    painted = Cover.of(hidden).paint(colour)
    assert painted.shape == colour.shape
    assert (painted[~hidden] == colour[~hidden]).all()
    assert abs(float(painted[hidden][:, 2].mean()) - float(image[~hidden].mean()) / 2) < 20


@pytest.mark.parametrize("frontend", [OrbFrontend(500), SiftFrontend(500)])
def test_the_features_budget_goes_to_the_scene(
    frontend: OrbFrontend | SiftFrontend, image: np.ndarray, hidden: BoolArray
) -> None:
    cover = Cover.of(hidden)
    view = view_of(Frame(0, 0.0, image), frontend, CAMERA, 0.5, cover)
    assert isinstance(view, View)
    uv = np.rint(view.features.uv_px).astype(int)
    assert (cover.distance_px[uv[:, 1], uv[:, 0]] > SUPPORT_PX * view.features.scale).all()
    plain = frontend.extract(image)
    seen_anyway = int(cover.shows(plain).sum())
    assert len(view.features) > 1.2 * seen_anyway


def test_a_frames_own_mask_and_what_is_found_are_hidden_together(image: np.ndarray, hidden: BoolArray) -> None:
    still = StillPixels((WIDTH, HEIGHT))
    scene = SceneMask(still)
    assert scene.cover_of(Frame(0, 0.0, image)) is None
    own = np.zeros_like(hidden)
    own[:10] = True
    cover = scene.cover_of(Frame(0, 0.0, image, hidden=own))
    assert cover is not None
    assert (cover.hidden == own).all()
    still.hidden = hidden
    both = scene.cover_of(Frame(1, 0.1, image, hidden=own))
    assert both is not None
    assert (both.hidden == own | hidden).all()


def test_views_of_before_lose_what_stands_still(image: np.ndarray, hidden: BoolArray) -> None:
    still = StillPixels((WIDTH, HEIGHT))
    scene = SceneMask(still)
    before = View(3, 0.3, OrbFrontend(500).extract(image), GreyImage.of(image))
    assert scene.masked(before) is before
    still.hidden = hidden
    masked = scene.masked(before)
    assert masked.image is not None
    assert 0 < len(masked.features) < len(before.features)
    assert Cover.of(hidden).shows(masked.features).all()
    assert (masked.image.pixels()[hidden] != image[hidden]).mean() > 0.9
    assert len(scene.masked(replace(before, image=None)).features) == len(masked.features)
