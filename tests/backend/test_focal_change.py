"""A focal length that changes during a run: found from what parts of a map say, and not where it stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.backend.focal_change import find_focal_change
from dualslam.build import adjust_submap
from dualslam.core.config.settings import CalibrationConfig
from dualslam.core.types import FloatArray
from dualslam.map.submap import Submap
from tests.backend.test_self_calibration import CONFIG, TRUE, make_submap, wrong_camera
from tests.seeds import first_of

N = 60


def zoomed(submap: Submap, factors: FloatArray) -> Submap:
    """Let each image be as much larger as is said, about its middle; the map fits them as well as it can."""
    middle = TRUE.K[:2, 2]
    for keyframe, factor in zip(list(submap.keyframes.values()), factors.tolist(), strict=True):
        uv = middle + factor * (keyframe.features.uv_px - middle)
        features = replace(keyframe.features, uv_px=uv, uv_rect_px=uv)
        submap.keyframes[keyframe.id] = replace(keyframe, features=features)
    adjust_submap(submap, 1.345)
    return submap


@pytest.mark.parametrize("seed", first_of([0, 1]))
@pytest.mark.parametrize("turning", [True, False])
def test_a_camera_that_stays_as_it_is_has_one_focal_length(turning: bool, seed: int) -> None:
    """Be it the one that was given or not."""
    for camera in (TRUE, wrong_camera(1.05)):
        submap = make_submap(camera, turning, N, seed=seed)
        adjust_submap(submap, 1.345)
        assert find_focal_change([submap], camera, config=CONFIG) is None


@pytest.mark.slow
@pytest.mark.parametrize("seed", first_of([0, 1]))
@pytest.mark.parametrize("factor", [1.3, 0.8])
def test_a_zoom_is_found(factor: float, seed: int) -> None:
    submap = zoomed(make_submap(TRUE, True, N, seed=seed), np.linspace(1.0, factor, N))
    found = find_focal_change([submap], TRUE, config=CONFIG)
    assert found is not None
    assert N // 4 <= found.keyframe_id <= 3 * N // 4
    assert 0 < found.log_change / np.log(factor) < 2  # a part over which the zoom moves errs itself


@pytest.mark.parametrize("seed", first_of([0, 1]))
def test_a_focus_that_moves_is_found_where_it_moves(seed: int) -> None:
    factors = np.where(np.arange(N) < N // 2, 1.0, 1.15)
    found = find_focal_change([zoomed(make_submap(TRUE, True, N, seed=seed), factors)], TRUE, config=CONFIG)
    assert found is not None
    assert found.keyframe_id == N // 2
    assert found.log_change == pytest.approx(np.log(1.15), abs=3 * found.sigma)


def test_a_camera_that_is_taken_at_its_word_is_not_asked() -> None:
    submap = zoomed(make_submap(TRUE, True, N), np.linspace(1.0, 1.3, N))
    assert find_focal_change([submap], TRUE, config=CalibrationConfig(refine=False)) is None
