from __future__ import annotations

import pickle

import numpy as np
import pytest

from dualslam.core.camera.base import Camera
from dualslam.core.camera.corrected import CorrectedCamera, LensCorrection, correct, correction_of, given_camera
from dualslam.core.camera.models import PinholeCamera, RadTanCamera, camera_from_dict
from dualslam.core.errors import InputError

PINHOLE = PinholeCamera(640, 480, 500.0, 505.0, 320.0, 240.0)
LENS = RadTanCamera(640, 480, 517.3, 516.5, 318.6, 255.3, k1=0.26, k2=-0.95, p1=-0.005, p2=0.003, k3=1.16)
SOME = LensCorrection(log_focal=-0.03, du_px=2.0, dv_px=-1.5, k1=0.02, k2=-0.01)


@pytest.mark.parametrize("base", [PINHOLE, LENS])
class TestCorrectedCamera:
    def test_no_correction_changes_nothing(self, base: Camera) -> None:
        uv = np.random.default_rng(0).uniform(0, 470, (50, 2))
        for got, want in zip(correct(base, LensCorrection()).rectify(uv), base.rectify(uv), strict=True):
            np.testing.assert_allclose(got, want, atol=1e-8)

    def test_project_and_unproject_are_inverse(self, base: Camera) -> None:
        camera = correct(base, SOME)
        p = np.random.default_rng(1).uniform([-0.4, -0.3, 1], [0.4, 0.3, 1.2], (50, 3))
        rays = camera.unproject(camera.project(p))
        np.testing.assert_allclose(rays, p / np.linalg.norm(p, axis=1)[:, None], atol=1e-9)

    def test_rectified_pixels_are_those_of_a_pinhole(self, base: Camera) -> None:
        camera = correct(base, SOME)
        p = np.random.default_rng(2).uniform([-0.4, -0.3, 1], [0.4, 0.3, 1.2], (50, 3))
        uv, magnification = camera.rectify(camera.project(p))
        pinhole = p @ camera.K.T
        np.testing.assert_allclose(uv, pinhole[:, :2] / pinhole[:, 2:], atol=1e-6)
        raw, step = camera.project(p), 1e-4
        du, dv = (camera.rectify(raw + d)[0] - camera.rectify(raw - d)[0] for d in step * np.eye(2))
        area = (du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]) / (4 * step * step)
        np.testing.assert_allclose(magnification**2, area, rtol=1e-5)

    def test_files_and_pickles(self, base: Camera) -> None:
        camera = correct(base, SOME)
        assert camera_from_dict(camera.to_dict()) == camera
        assert pickle.loads(pickle.dumps(camera)) == camera

    def test_a_correction_replaces_the_one_before(self, base: Camera) -> None:
        again = correct(correct(base, LensCorrection(k1=0.1)), SOME)
        assert given_camera(again) == base
        assert correction_of(again) == SOME

    def test_scaled(self, base: Camera) -> None:
        camera = correct(base, SOME)
        p = np.array([[0.2, -0.1, 1.0]])
        half = camera.scaled(0.5)
        np.testing.assert_allclose(half.project(p), (camera.project(p) + 0.5) / 2 - 0.5, atol=1e-9)


def test_a_correction_without_inverse_is_refused() -> None:
    with pytest.raises(InputError, match="no inverse"):
        correct(PINHOLE, LensCorrection(k1=-3.0))
    with pytest.raises(InputError, match="finite"):
        correct(PINHOLE, LensCorrection(k1=float("nan")))
    with pytest.raises(InputError, match="'base'"):
        CorrectedCamera.from_dict({"model": "corrected"})
