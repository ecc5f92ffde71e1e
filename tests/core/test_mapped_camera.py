"""A camera that looks at another one's map: same rays, the map's pixels; what counts as the same camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualslam.core.camera.base import Camera
from dualslam.core.camera.corrected import LensCorrection, correct
from dualslam.core.camera.mapped import MappedCamera, camera_for_map
from dualslam.core.camera.models import KannalaBrandtCamera, PinholeCamera, RadTanCamera, camera_from_dict

MAP = RadTanCamera(640, 480, 585.0, 586.0, 320.0, 240.0, k1=-0.1)
CORRECTED = correct(MAP, LensCorrection(log_focal=0.01, k1=0.005))
OTHERS = [
    PinholeCamera(640, 480, 760.0, 761.0, 310.0, 250.0),
    KannalaBrandtCamera(512, 512, 190.0, 191.0, 254.0, 256.0, 0.003, 0.0007, -0.002, 0.0002),
]


@pytest.mark.parametrize("camera", OTHERS, ids=lambda c: c.model)
def test_another_camera_has_its_own_rays_and_the_pixels_of_the_map(camera: Camera) -> None:
    mapped = camera_for_map(CORRECTED, camera)
    assert isinstance(mapped, MappedCamera)
    np.testing.assert_array_equal(mapped.K, CORRECTED.K)
    assert mapped.size_px == camera.size_px
    uv = 0.5 * np.array(camera.size_px) + np.random.default_rng(0).uniform(-100, 100, (50, 2))
    rays = camera.unproject(uv)
    rectified, magnification = mapped.rectify(uv)
    np.testing.assert_allclose(rectified, (rays @ mapped.K.T)[:, :2] / rays[:, 2:], atol=1e-6)
    np.testing.assert_allclose(mapped.unrectify(rectified), uv, atol=1e-6)
    assert mapped.shows(rectified).all()
    h = 1e-3
    columns = [(mapped.rectify(uv + d)[0] - mapped.rectify(uv - d)[0]) / (2 * h) for d in ((h, 0), (0, h))]
    area = columns[0][:, 0] * columns[1][:, 1] - columns[0][:, 1] * columns[1][:, 0]
    np.testing.assert_allclose(magnification, np.sqrt(area), rtol=1e-5)
    assert camera_from_dict(mapped.to_dict()) == mapped


def test_the_same_camera_to_a_thousandth_of_a_pixel_is_the_same() -> None:
    assert camera_for_map(CORRECTED, replace(MAP, fx=585.001)) is CORRECTED
    assert camera_for_map(CORRECTED, PinholeCamera(640, 480, 585.0, 586.0, 320.0, 240.0)) is not CORRECTED, (
        "a lens less"
    )


def test_a_map_that_was_extended_by_another_camera_knows_that_one_again() -> None:
    mapped = camera_for_map(CORRECTED, OTHERS[0])
    assert camera_for_map(mapped, OTHERS[0]) is mapped
    np.testing.assert_array_equal(camera_for_map(mapped, MAP).K, CORRECTED.K)


def test_a_circle_that_fills_a_third_of_the_image_is_of_the_same_camera() -> None:
    circle = KannalaBrandtCamera(1920, 1080, 420.6, 421.7, 959.9, 542.8, -0.01197, -0.0393, 0.01858, -0.005076)
    corrected = correct(circle, LensCorrection(log_focal=0.01))
    assert camera_for_map(corrected, replace(circle, fx=420.601)) is corrected
    assert camera_for_map(corrected, replace(circle, fx=430.0)) is not corrected
