"""The focal length that a saved map's points tell of frames, and what a run makes of it."""

from __future__ import annotations

from math import log

import numpy as np
import pytest

from dualslam.core.camera.base import Camera
from dualslam.core.camera.models import PinholeCamera
from dualslam.core.config.settings import Config
from dualslam.core.geometry.so3 import exp
from dualslam.run import map_camera
from dualslam.run.map_camera import _Seen, camera_that_fits, log_focal_of, own_focal_px

SIGMA = 1.0 / 500.0


def seen_by(log_zoom: float, n: int, seed: int, flat: bool = False) -> list[_Seen]:
    """Frames of a camera with another focal length, posed by the wrong one: as if from nearer, or farther."""
    rng = np.random.default_rng(seed)
    frames = []
    for _ in range(n):
        xyz = np.column_stack([rng.uniform(-2, 2, (150, 2)), np.full(150, 6.0) if flat else rng.uniform(3, 12, 150)])
        R, t = exp(rng.normal(0, 0.02, 3)), rng.normal(0, 0.1, 3)
        p = xyz @ R.T + t
        xy = np.exp(log_zoom) * p[:, :2] / p[:, 2:] + rng.normal(0, SIGMA, (150, 2))
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, t - (0, 0, 0.5 * log_zoom * 6.0)
        frames.append(_Seen(T, xyz, xy, np.full(150, SIGMA)))
    return frames


@pytest.mark.parametrize("log_zoom", [-0.3, 0.0, 0.02, 0.26])
def test_points_at_several_depths_tell_the_focal_length(log_zoom: float) -> None:
    errors = []
    for seed in range(5):
        found, sigma = log_focal_of(seen_by(log_zoom, 6, seed))
        assert 0 < sigma < 0.01
        errors.append((found - log_zoom) / sigma)
    assert np.abs(errors).max() < 4.0


def test_a_wall_tells_nothing() -> None:
    _, sigma = log_focal_of(seen_by(0.0, 3, 0, flat=True))
    _, deep = log_focal_of(seen_by(0.0, 3, 0))
    assert sigma > 3 * deep
    assert log_focal_of([]) is None


@pytest.mark.parametrize(("zoom", "reach"), [(2.0, 0.4), (0.5, 0.4), (1.3, 0.4), (2.0, 0.0)])
def test_a_zoom_is_searched_for_although_no_frame_is_found_as_given(
    zoom: float, reach: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`reach`: of the log focal length, within which frames of the map are found."""
    given = PinholeCamera(width=640, height=480, fx=500.0, fy=500.0, cx=319.5, cy=239.5)

    def found(_config: object, _frames: object, camera: Camera, _saved: object) -> list[_Seen]:
        off = log(zoom * given.fx / own_focal_px(camera))
        return seen_by(off, 6, 0) if abs(off) < reach else []

    monkeypatch.setattr(map_camera, "load_camera", lambda _: given)
    monkeypatch.setattr(map_camera, "load_atlas", lambda _: None)
    monkeypatch.setattr(map_camera, "_frames_in_map", found)
    camera = camera_that_fits(Config(), [], given, "map")
    assert own_focal_px(camera) == pytest.approx((zoom if reach else 1.0) * given.fx, rel=0.01)
