"""Camera models: OpenCV as oracle, round trips, magnification against numerical derivatives, calibrations refused."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
import pytest

from dualslam.core.camera.base import Camera
from dualslam.core.camera.models import (
    DivisionCamera,
    FovCamera,
    KannalaBrandtCamera,
    PinholeCamera,
    RadTanCamera,
    camera_from_dict,
    camera_from_fov,
)
from dualslam.core.camera.sphere import DoubleSphereCamera, EucmCamera, OmniCamera
from dualslam.core.errors import InputError

ROUND_TRIP_PX = 1e-7
ORACLE_PX = 1e-4

PINHOLE = PinholeCamera(1241, 376, 718.856, 718.856, 607.1928, 185.2157)
# TUM freiburg1, EuRoC cam0, TUM-VI (512), TUM-Mono.
FR1 = RadTanCamera(640, 480, 517.306, 516.469, 318.643, 255.314, 0.262383, -0.953104, -0.005358, 0.002628, 1.163314)
EUROC = RadTanCamera(752, 480, 458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
TUMVI = KannalaBrandtCamera(
    512, 512, 190.978, 190.973, 254.932, 256.897, 0.00348239, 0.000715035, -0.00205324, 0.000202936
)
TUMMONO = FovCamera.from_tum_mono(0.535719308086809, 0.669566858850269, 0.493248545285398, 0.500408664348414,
                                  0.897966326944875, 1280, 1024)  # fmt: skip
# The examples of Kalibr's and Basalt's pages, or near them.
OMNI = OmniCamera(752, 480, 1200.0, 1201.0, 367.0, 248.0, xi=1.9, k1=-0.1, k2=0.02, p1=0.0003, p2=-0.0006)
UCM = OmniCamera(752, 480, 350.0, 351.0, 367.0, 248.0, xi=0.7)
EUCM = EucmCamera(512, 512, 220.0, 221.0, 255.0, 256.0, alpha=0.6, beta=1.1)
SPHERES = DoubleSphereCamera(512, 512, 150.0, 151.0, 255.0, 256.0, xi=-0.2, alpha=0.59)
BARREL = DivisionCamera(752, 480, 461.0, 461.0, 375.5, 239.5, k=-0.3)
CAMERAS = [PINHOLE, FR1, EUROC, TUMVI, TUMMONO, BARREL, OMNI, UCM, EUCM, SPHERES]
IDS = ["pinhole", "fr1", "euroc", "tumvi", "tummono", "division", "omni", "ucm", "eucm", "double_sphere"]


def pixels(camera: Camera, seed: int = 0, n: int = 400, middle: float = 1.0) -> np.ndarray:
    """Return random pixels of the image, or of its middle part."""
    rng = np.random.default_rng(seed)
    size = np.array([camera.width - 1.0, camera.height - 1.0])
    return 0.5 * size + rng.uniform(-0.5, 0.5, (n, 2)) * size * middle


def project_pinhole(K: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return pixels of rays under K."""
    uv = rays @ K.T
    return uv[:, :2] / uv[:, 2:]


@pytest.mark.parametrize("camera", CAMERAS, ids=IDS)
def test_project_inverts_unproject(camera: Camera) -> None:
    """Pixels come back through unit rays, of any length."""
    uv = pixels(camera, middle=0.7)
    rays = camera.unproject(uv)
    assert np.isfinite(rays).all()
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(camera.project(3.7 * rays), uv, atol=ROUND_TRIP_PX)


@pytest.mark.parametrize("camera", CAMERAS, ids=IDS)
def test_rectified_pixels_are_those_of_the_pinhole(camera: Camera) -> None:
    """`rectify` is unprojection followed by K."""
    uv = pixels(camera, middle=0.6)
    rect, _ = camera.rectify(uv)
    np.testing.assert_allclose(rect, project_pinhole(camera.K, camera.unproject(uv)), atol=ROUND_TRIP_PX)


@pytest.mark.parametrize("camera", CAMERAS, ids=IDS)
def test_rectified_pixels_are_told_to_be_in_the_image_or_not(camera: Camera) -> None:
    """All pixels come back and are in the image, in its corners too; what is a pixel beyond its border is not."""
    uv = pixels(camera)
    rect, _ = camera.rectify(uv)
    known = np.isfinite(rect).all(1)
    assert known.mean() > 0.8  # the TUM-VI lens and the double sphere has corners beyond 80 degrees
    np.testing.assert_allclose(camera.unrectify(rect[known]), uv[known], atol=ROUND_TRIP_PX)
    assert np.array_equal(camera.shows(rect), known)
    beyond = np.concatenate([uv * (1, 0) - (0, 1), uv * (0, 1) - (1, 0), uv * (1, 0) + (0, camera.height)])
    assert not camera.shows(camera.rectify(beyond)[0]).any()


@pytest.mark.parametrize("camera", CAMERAS, ids=IDS)
def test_magnification_is_the_area_derivative(camera: Camera) -> None:
    """Root of the determinant of the numerical Jacobian; 1 at the principal point."""
    uv, h = pixels(camera, middle=0.6), 1e-3
    _, magnification = camera.rectify(uv)
    columns = [
        (camera.rectify(uv + d)[0] - camera.rectify(uv - d)[0]) / (2 * h) for d in (np.array([h, 0]), np.array([0, h]))
    ]
    det = columns[0][:, 0] * columns[1][:, 1] - columns[0][:, 1] * columns[1][:, 0]
    np.testing.assert_allclose(magnification, np.sqrt(det), rtol=1e-5)
    _, centre = camera.rectify([[camera.cx, camera.cy]])
    np.testing.assert_allclose(centre, 1.0, atol=1e-9)


@pytest.mark.parametrize("camera", [FR1, EUROC], ids=["fr1", "euroc"])
def test_radtan_agrees_with_opencv(camera: RadTanCamera) -> None:
    """Projection with cv2.projectPoints, rectification with cv2.undistortPoints."""
    K = camera.K
    d = np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])
    rays = camera.unproject(pixels(camera, middle=0.8)) * 5.0
    theirs = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, d)[0].reshape(-1, 2)
    np.testing.assert_allclose(camera.project(rays), theirs, atol=1e-9)
    uv = pixels(camera, seed=1, middle=0.95)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    theirs = cv2.undistortPoints(uv.reshape(-1, 1, 2), K, d, R=np.eye(3), P=K, criteria=criteria).reshape(-1, 2)
    np.testing.assert_allclose(camera.rectify(uv)[0], theirs, atol=ORACLE_PX)


def test_models_of_a_sphere_project_as_their_papers_say() -> None:
    """Each formula with the letters of its paper, for rays up to 100 degrees from the axis."""
    rng = np.random.default_rng(3)
    theta, phi = rng.uniform(0.0, math.radians(100.0), 200), rng.uniform(0.0, 2.0 * math.pi, 200)
    p = 2.5 * np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], 1)
    x, y, z = p.T
    xi, alpha, beta = SPHERES.xi, SPHERES.alpha, EUCM.beta
    d1 = np.sqrt(x * x + y * y + z * z)
    d2 = np.sqrt(x * x + y * y + (xi * d1 + z) ** 2)
    divisor = alpha * d2 + (1 - alpha) * (xi * d1 + z)  # Usenko (2018), Eq. (40)
    np.testing.assert_allclose(SPHERES.project(p), np.stack([150 * x, 151 * y], 1) / divisor[:, None] + (255, 256))
    alpha = EUCM.alpha
    divisor = alpha * np.sqrt(beta * (x * x + y * y) + z * z) + (1 - alpha) * z  # Khomutenko (2016)
    np.testing.assert_allclose(EUCM.project(p), np.stack([220 * x, 221 * y], 1) / divisor[:, None] + (255, 256))
    x, y = x / (z + UCM.xi * d1), y / (z + UCM.xi * d1)  # Mei (2007)
    np.testing.assert_allclose(UCM.project(p), np.stack([350 * x + 367, 351 * y + 248], 1))


def test_kannala_brandt_agrees_with_opencv_fisheye() -> None:
    """Projection and rectification with cv2.fisheye, within its own domain."""
    K, d = TUMVI.K, np.array([TUMVI.k1, TUMVI.k2, TUMVI.k3, TUMVI.k4])
    uv = pixels(TUMVI, middle=0.6)
    rays = TUMVI.unproject(uv)
    theirs = cv2.fisheye.projectPoints(rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, d)[0].reshape(-1, 2)
    np.testing.assert_allclose(TUMVI.project(rays), theirs, atol=1e-9)
    theirs = cv2.fisheye.undistortPoints(uv.reshape(-1, 1, 2), K, d, R=np.eye(3), P=K).reshape(-1, 2)
    np.testing.assert_allclose(TUMVI.rectify(uv)[0], theirs, atol=ORACLE_PX)


def test_kannala_brandt_images_rays_behind_the_plane() -> None:
    """A ray at 93 degrees has a pixel, but no rectified one."""
    ray = np.array([[math.sin(math.radians(93)), 0.0, math.cos(math.radians(93))]])
    uv = TUMVI.project(ray)
    np.testing.assert_allclose(TUMVI.unproject(uv), ray, atol=1e-9)
    rect, magnification = TUMVI.rectify(uv)
    assert np.isnan(rect).all()
    assert np.isnan(magnification).all()


@pytest.mark.parametrize("degrees", [79.0, 81.0])
def test_rectification_ends_at_eighty_degrees(degrees: float) -> None:
    """On either side of the limit."""
    ray = np.array([[math.sin(math.radians(degrees)), 0.0, math.cos(math.radians(degrees))]])
    assert np.isnan(TUMVI.rectify(TUMVI.project(ray))[0]).any() == (degrees > 80)


@pytest.mark.parametrize("k", [-0.3, 0.1], ids=["barrel", "pincushion"])
def test_division_follows_its_formula(k: float) -> None:
    """r_u = r_d / (1 + k r_d^2), written out."""
    camera = DivisionCamera(640, 480, 500.0, 500.0, 319.5, 239.5, k=k)
    ray = camera.unproject([[319.5 + 500.0 * 0.3, 239.5 - 500.0 * 0.4]])[0]
    np.testing.assert_allclose(ray[:2] / ray[2], np.array([0.3, -0.4]) / (1 + k * 0.25), atol=1e-12)


def test_fov_follows_its_formula() -> None:
    """r_d = atan(2 r tan(omega / 2)) / omega, written out."""
    p = np.array([[0.3, -0.4, 1.0]])
    radius = math.atan(2 * 0.5 * math.tan(0.5 * TUMMONO.omega)) / TUMMONO.omega
    expected = [TUMMONO.fx * 0.3 / 0.5 * radius + TUMMONO.cx, TUMMONO.fy * -0.4 / 0.5 * radius + TUMMONO.cy]
    np.testing.assert_allclose(TUMMONO.project(p)[0], expected, atol=1e-9)


def test_tum_mono_calibrations() -> None:
    """Relative values, absolute values, and no distortion."""
    assert abs(TUMMONO.cx - (0.493248545285398 * 1280 - 0.5)) < 1e-9
    assert abs(TUMMONO.fy - 0.669566858850269 * 1024) < 1e-9
    absolute = FovCamera.from_tum_mono(500.0, 510.0, 320.0, 240.0, 0.9, 640, 480)
    assert (absolute.fx, absolute.cx) == (500.0, 320.0)
    assert isinstance(FovCamera.from_tum_mono(0.5, 0.6, 0.5, 0.5, 0.0, 640, 480), PinholeCamera)


def test_points_outside_the_invertible_radius_are_nan() -> None:
    """A strong barrel: the polynomial turns back, so far points and far pixels have no partner."""
    camera = RadTanCamera(640, 480, 600.0, 600.0, 320.0, 240.0, k1=-0.3)
    limit = 1 / math.sqrt(0.9)
    inside, outside = np.array([[0.99 * limit, 0.0, 1.0]]), np.array([[1.2 * limit, 0.0, 1.0]])
    assert np.isfinite(camera.project(inside)).all()
    assert np.isnan(camera.project(outside)).all()
    largest = limit * (1 - 0.3 * limit**2) * 600
    assert np.isfinite(camera.unproject([[320 + 0.999 * largest, 240]])).all()
    assert np.isnan(camera.unproject([[320 + 1.001 * largest, 240]])).all()
    tangential = dataclasses.replace(camera, p1=1e-3, p2=-1e-3)
    assert np.isnan(tangential.unproject([[320 + 1.2 * largest, 240]])).all()


@pytest.mark.parametrize("camera", [PINHOLE, FR1, TUMMONO], ids=["pinhole", "fr1", "tummono"])
def test_points_behind_are_not_imaged(camera: Camera) -> None:
    """NaN, without a warning."""
    assert np.isnan(camera.project([[0.1, 0.1, -1.0], [0.1, 0.0, 0.0], [0.0, 0.0, -1.0]])).all()


@pytest.mark.parametrize("camera", CAMERAS, ids=IDS)
def test_scaled_image_shows_the_same_rays(camera: Camera) -> None:
    """The corner of the top-left pixel, at -0.5, stays where it is."""
    half = camera.scaled(0.5)
    uv = pixels(camera, middle=0.6)
    sx, sy = half.width / camera.width, half.height / camera.height
    np.testing.assert_allclose(half.unproject((uv + 0.5) * (sx, sy) - 0.5), camera.unproject(uv), atol=1e-9)


@pytest.mark.parametrize("camera", CAMERAS, ids=IDS)
def test_dict_round_trip(camera: Camera) -> None:
    """Same class, same numbers."""
    assert camera_from_dict(camera.to_dict()) == camera


def test_field_of_view() -> None:
    """The outer edges of the image, half a pixel beyond the outer pixels, are the field of view apart."""
    camera = camera_from_fov(640, 480, 90.0)
    edges = camera.unproject([[-0.5, 239.5], [639.5, 239.5]])
    np.testing.assert_allclose(edges[0] @ edges[1], 0.0, atol=1e-12)


def test_field_of_view_of_an_upright_image_is_that_of_its_longer_side() -> None:
    """As a telephone's maker tells it, however it is held."""
    upright, lying = camera_from_fov(480, 640, 70.0), camera_from_fov(640, 480, 70.0)
    assert (upright.fx, upright.fy) == (lying.fx, lying.fy)
    assert (upright.cx, upright.cy) == (lying.cy, lying.cx)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"fx": 0.0}, "fx"),
        ({"fy": -1.0}, "fy"),
        ({"fx": math.nan}, "fx"),
        ({"fx": 1e300}, "fx is 1e.300, for images of 640 x 480 it must be 32 to 64000 pixels"),
        ({"fy": 4.2}, "fy is 4.2, for images of 640 x 480 it must be 32 to 64000 pixels"),
        ({"width": 0}, "width"),
        ({"cx": 641.0}, "cx"),
        ({"cy": -2.0}, "cy"),
        ({"k1": -4.0}, "distortion"),
        ({"model": "lens"}, "model"),
        ({"k9": 1.0}, "k9"),
        ({"fx": "500"}, "fx"),
        ({"width": 640.5}, "width"),
    ],
)
def test_senseless_calibrations_are_refused_by_name(change: dict[str, object], word: str) -> None:
    """One sentence that names the field."""
    with pytest.raises(InputError, match=word):
        camera_from_dict(FR1.to_dict() | change)


def test_missing_field_and_bad_omega_are_refused() -> None:
    """Missing size, impossible omega, impossible field of view."""
    values = FR1.to_dict()
    del values["width"]
    with pytest.raises(InputError, match="width"):
        camera_from_dict(values)
    with pytest.raises(InputError, match="omega"):
        FovCamera(640, 480, 500.0, 500.0, 320.0, 240.0, 4.0)
    with pytest.raises(InputError, match="field of view"):
        camera_from_fov(640, 480, 180.0)


def test_the_circle_of_a_fisheye_lens_may_end_in_the_image() -> None:
    """A GoPro's calibration, as published, ends at 104 degrees: within the image. One that ends at 50 is a slip."""
    lens = {"k1": -0.02196, "k2": -0.01896, "k3": 0.001694, "k4": -0.000168}
    gopro = KannalaBrandtCamera(2704, 2028, 796.9, 799.2, 1354.4, 1011.5, **lens)
    inside, beyond = gopro.rectify([[400.0, 1011.5], [100.0, 1011.5]])[0]
    assert np.isfinite(inside).all()
    assert np.isnan(beyond).all()
    with pytest.raises(InputError, match="no inverse at pixel"):
        KannalaBrandtCamera(2704, 2028, 796.9, 799.2, 1354.4, 1011.5, **lens | {"k1": -0.44})
