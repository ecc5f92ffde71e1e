"""The camera of which nothing is known: focal length, lens, and how sure both are."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dualslam.build import create_frontend
from dualslam.core.camera.base import Camera
from dualslam.core.camera.focal import FocalSearch
from dualslam.core.camera.models import DivisionCamera, PinholeCamera
from dualslam.core.config.settings import FrontendConfig
from dualslam.core.types import Failure, Features
from dualslam.frontends.tracking import focal_search
from dualslam.frontends.tracking.focal_search import search_focal
from dualslam.testing.point_world import CAMERA, SIZE_PX, PointWorld, cloud, hand_held, path


def features_of(world: PointWorld, camera: Camera = CAMERA) -> list[Features]:
    """Return what another lens in the same place makes of the world's features."""
    seen = [world.features(i) for i in range(len(world.T_world_cam))]
    return [replace(each, uv_px=camera.project(CAMERA.unproject(each.uv_px))) for each in seen]


@pytest.fixture(autouse=True)
def _few_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """For time's sake: they tell less, but enough for these worlds."""
    monkeypatch.setattr(focal_search, "MAX_PAIRS", 12)


def search(features: list[Features], seed: int = 0, size_px: tuple[int, int] = SIZE_PX) -> FocalSearch | Failure:
    return search_focal(create_frontend(FrontendConfig()), features, size_px, seed)


@cache
def found_hand_held(seed: int) -> FocalSearch | Failure:
    return search(features_of(PointWorld(cloud(seed=seed), hand_held(40), seed=seed)), seed)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_hand_held_camera_tells_its_focal_length(seed: int) -> None:
    found = found_hand_held(seed)
    assert isinstance(found, FocalSearch)
    assert found.focal_px == pytest.approx(CAMERA.fx, rel=0.05)
    low, high = found.range_px
    assert low <= CAMERA.fx <= high
    assert high / low < 1.3
    assert isinstance(found.camera(), PinholeCamera)
    low, high = found.fov_range_deg
    assert low <= found.fov_deg <= high


@pytest.mark.slow
def test_a_lens_is_found_with_the_focal_length() -> None:
    camera = DivisionCamera(*SIZE_PX, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, k=-0.3)
    found = search(features_of(PointWorld(cloud(), hand_held(40)), camera))
    assert isinstance(found, FocalSearch)
    assert found.focal_px == pytest.approx(CAMERA.fx, rel=0.06)
    assert found.lens == pytest.approx(-0.3 / (2 * CAMERA.fx / CAMERA.width) ** 2, abs=0.04)
    made = found.camera()
    assert isinstance(made, DivisionCamera)
    ray = made.unproject([[30.0, 30.0]])[0]
    true = camera.unproject([[30.0, 30.0]])[0]
    assert np.degrees(np.arccos(ray @ true)) < 3.0


@pytest.mark.slow
def test_it_does_not_matter_how_a_telephone_was_held() -> None:
    level = features_of(PointWorld(cloud(), hand_held(40)))
    upright = [replace(each, uv_px=each.uv_px[:, ::-1] * (-1, 1) + (CAMERA.height - 1, 0)) for each in level]
    a, b = found_hand_held(0), search(upright, size_px=(CAMERA.height, CAMERA.width))
    assert isinstance(a, FocalSearch)
    assert isinstance(b, FocalSearch)
    assert b.focal_px == pytest.approx(a.focal_px, rel=0.02)
    assert b.fov_deg < a.fov_deg


@pytest.mark.slow
def test_a_straight_drive_does_not_claim_to_know() -> None:
    """It leaves the focal length to what cameras are like, and says so."""
    turning = found_hand_held(0)
    straight = search(features_of(PointWorld(cloud(length_m=20.0), path(40, np.array([0.0, 0.0, 0.12]), np.zeros(3)))))
    assert isinstance(turning, FocalSearch)
    assert isinstance(straight, FocalSearch)
    assert straight.log_sigma > 2.0 * turning.log_sigma
    low, high = straight.range_px
    assert low <= CAMERA.fx <= high


@pytest.mark.parametrize("turn_rad", [[0, 0, 0], [0, 0.0002, 0]], ids=["still", "hardly"])
def test_a_camera_that_stands_still_tells_nothing(turn_rad: list[float]) -> None:
    world = PointWorld(cloud(), path(60, np.zeros(3), np.array(turn_rad)))
    assert isinstance(search(features_of(world)), Failure)
