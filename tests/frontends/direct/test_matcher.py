"""The built-in pixel matcher: it conforms, and finds landmarks through motion blur and fast turns, or none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dualslam.build.checks import check_config
from dualslam.core.config.corruption import Corruption, CorruptionKind
from dualslam.core.config.settings import Config, PixelsConfig
from dualslam.core.errors import ConfigError
from dualslam.core.geometry import se3, so3
from dualslam.core.matchers import PixelMatches
from dualslam.core.types import FloatArray
from dualslam.frontends.conformance.scene import PrintedPlane, transfer
from dualslam.frontends.direct.matcher import DirectMatcher
from dualslam.frontends.direct.patches import Smear
from dualslam.frontends.direct.warp import project_with_jacobians
from dualslam.lab.disturbances.images import corrupt_image
from dualslam.testing.pixel_matching import CAMERA, CHECKS, SIZE_PX, plane_views


def errors_px(found: PixelMatches, uv_true_px: FloatArray) -> FloatArray:
    row = np.searchsorted(plane_views().reference.landmark_ids, found.landmark_ids)
    return np.asarray(np.linalg.norm(found.uv_px - uv_true_px[row], axis=1))


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_it_conforms(check: Any) -> None:
    check(DirectMatcher)


@pytest.mark.parametrize("length_px", [30.0, 60.0])
def test_motion_blur_is_taken_into_account(length_px: float) -> None:
    views = plane_views()
    blur = Corruption(kind=CorruptionKind.MOTION_BLUR, start=0, length=1, strength=length_px)
    found = DirectMatcher().find((views.reference,), corrupt_image(views.image, blur, 0), CAMERA, np.eye(4))
    assert len(found) > 0.8 * len(views.reference.landmark_ids)
    assert np.median(errors_px(found, views.uv_true_px)) < 1.0


def test_a_turn_of_ten_degrees_is_found_from_the_whole_image() -> None:
    T = se3.from_parts(so3.exp(np.radians([0.0, 10.0, 0.0])), np.zeros(3))
    H = CAMERA.K @ T[:3, :3] @ np.linalg.inv(CAMERA.K)
    image, uv_px = PrintedPlane.printed(3, SIZE_PX).photograph(H, seed=2), transfer(H, plane_views().reference.uv_px)
    found = DirectMatcher().find((plane_views().reference,), image, CAMERA, np.eye(4))
    in_view = ((uv_px > 25) & (uv_px < np.array(SIZE_PX) - 26)).all(axis=1)
    assert len(found) > 0.8 * in_view.sum()
    assert np.median(errors_px(found, uv_px)) < 0.5


def test_a_blurred_reference_leaves_its_landmarks_to_a_sharp_one() -> None:
    views = plane_views()
    blur = Corruption(kind=CorruptionKind.BLUR, start=0, length=1, strength=12.0)
    blurred = replace(views.reference, image=corrupt_image(views.reference.image, blur, 0))
    found = DirectMatcher().find((blurred, views.reference), views.image, CAMERA, np.eye(4))
    assert len(found) > 0.9 * len(views.reference.landmark_ids)
    assert np.median(errors_px(found, views.uv_true_px)) < 0.3


def test_the_smear_of_a_point_is_a_line_about_it() -> None:
    point = np.zeros((41, 61), np.float32)
    point[20, 30] = 1.0
    smeared = Smear(0.0, 16.0).of(point, 0)
    assert smeared.sum() == pytest.approx(1.0, abs=1e-5)
    assert np.flatnonzero(smeared.sum(axis=0) > 1e-6).tolist() == list(range(22, 39))
    np.testing.assert_allclose(smeared, smeared[:, ::-1], atol=1e-6)


def test_derivatives_of_the_projection() -> None:
    p = np.random.default_rng(0).uniform([-0.4, -0.3, 1.0], [0.4, 0.3, 3.0], (20, 3))
    _, J = project_with_jacobians(CAMERA, p)
    for axis in range(3):
        h = np.eye(3)[axis] * 1e-5
        np.testing.assert_allclose(J[:, :, axis], (CAMERA.project(p + h) - CAMERA.project(p - h)) / 2e-5, rtol=3e-3)


def test_a_wrong_option_is_named() -> None:
    with pytest.raises(ConfigError, match=r"pixels\.options\.share: there is no such option \(pixel matcher 'direct'"):
        check_config(Config(pixels=PixelsConfig(name="direct", options={"share": 0.5})))
