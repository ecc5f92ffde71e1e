"""The focal length of a camera of which nothing is known."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.build import create_frontend
from dualslam.config.settings import FrontendConfig
from dualslam.core.camera.focal import FocalSearch
from dualslam.core.types import Failure
from dualslam.frontends.tracking.focal_search import search_focal
from dualslam.testing.point_world import CAMERA, SIZE_PX, PointWorld, cloud, hand_held, path


@pytest.mark.parametrize("seed", [0, 1])
def test_a_hand_held_camera_tells_its_focal_length(seed: int) -> None:
    world = PointWorld(cloud(seed=seed), hand_held(60), seed=seed)
    features = [world.features(i) for i in range(60)]
    found = search_focal(create_frontend(FrontendConfig()), features, SIZE_PX, seed)
    assert isinstance(found, FocalSearch)
    assert found.focal_px == pytest.approx(CAMERA.fx, rel=0.08)
    assert found.low_px <= CAMERA.fx <= found.high_px
    low, high = found.fov_range_deg
    assert low <= found.fov_deg <= high


@pytest.mark.parametrize("turn_rad", [[0, 0, 0], [0, 0.0005, 0]], ids=["still", "hardly"])
def test_a_camera_that_stands_still_tells_nothing(turn_rad: list[float]) -> None:
    world = PointWorld(cloud(), path(60, np.zeros(3), np.array(turn_rad)))
    found = search_focal(create_frontend(FrontendConfig()), [world.features(i) for i in range(60)], SIZE_PX, 0)
    assert isinstance(found, Failure)
