"""Motion statistics: the same matches as OpenCV contrib's, and what the front end makes of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from dualslam.core.config.settings import Config, FrontendConfig, InitialiserConfig
from dualslam.core.errors import ConfigError
from dualslam.core.types import FloatArray
from dualslam.frontends.features.gms import GmsFrontend, GmsOptions
from dualslam.frontends.features.motion_statistics import match_by_motion, supported_matches
from dualslam.frontends.features.orb import OrbFrontend
from dualslam.frontends.features.sift import SiftFrontend
from dualslam.frontends.registry import create_frontend
from dualslam.frontends.tracking.initialiser import Initialiser
from dualslam.testing.point_world import CAMERA, SIZE_PX, PointWorld, cloud, path, pose_errors
from tests.frontends.features.test_orb import warped

ORACLE = Path(__file__).with_name("gms_oracle.npz")
"""Pairs and what contrib says of them: `tools/gms_oracle.py` made it."""
SETTINGS = ((False, False), (True, False), (False, True), (True, True))


@pytest.mark.parametrize("setting", range(4), ids=["plain", "rotation", "zoom", "both"])
def test_matches_are_those_of_opencv_contrib(setting: int) -> None:
    rotation, zoom = SETTINGS[setting]
    with np.load(ORACLE) as oracle:
        n, size_px = oracle["n"], oracle["size_px"].tolist()
        uv_a, uv_b = oracle["uv_a"] / 16.0, oracle["uv_b"] / 16.0
        expected = np.unpackbits(oracle["masks"][setting], count=int(n.sum())).astype(np.bool_)
    assert len(n) >= 60
    assert 0.1 < expected.mean() < 0.9
    for begin, end, (width, height) in zip(np.cumsum(n) - n, np.cumsum(n), size_px, strict=True):
        size = (width, height)
        ours = supported_matches(uv_a[begin:end], uv_b[begin:end], size, size, rotation=rotation, zoom=zoom)
        np.testing.assert_array_equal(ours, expected[begin:end])


def test_right_and_wrong_matches_are_told_apart() -> None:
    rng = np.random.default_rng(1)
    uv_a = rng.uniform(0, 1, (2000, 2)) * (640, 480)
    uv_b = np.clip(uv_a + (25.0, -10.0) + rng.normal(0, 1, uv_a.shape), 0, (639, 479))
    wrong = rng.random(2000) < 0.5
    uv_b[wrong] = rng.uniform(0, 1, (int(wrong.sum()), 2)) * (640, 480)
    kept = supported_matches(uv_a, uv_b, (640, 480), (640, 480))
    assert kept[~wrong].mean() > 0.5
    assert kept[wrong].mean() < 0.01
    assert not supported_matches(uv_a, rng.permutation(uv_b), (640, 480), (640, 480)).any()


def test_no_matches_and_one_cell_are_no_error() -> None:
    nothing = np.empty((0, 2))
    assert supported_matches(nothing, nothing, (10, 10), (10, 10), rotation=True, zoom=True).shape == (0,)
    assert supported_matches(np.ones((3, 2)), np.ones((3, 2)), (10, 10), (10, 10), zoom=True, cells=1).shape == (3,)


def right_share(frontend: OrbFrontend, image: NDArray[np.uint8], zoom: float, degrees: float) -> tuple[int, float]:
    other, affine = warped(image, zoom, degrees)
    a, b = frontend.extract(image), frontend.extract(other)
    matches = frontend.match_wide(a, b)
    first, second = matches.index.T
    assert len(set(second.tolist())) == len(second)
    np.testing.assert_array_equal(matches.distance, frontend.distance(a.descriptors[first], b.descriptors[second]))
    error = b.uv_px[second] - (a.uv_px[first] @ affine[:, :2].T + affine[:, 2])
    return len(matches), float((np.hypot(*error.T) < 3 * a.scale[first]).mean()) if len(matches) else 0.0


@pytest.mark.parametrize(
    ("options", "zoom", "degrees"),
    [
        (GmsOptions(), 1.0, 3.0),
        (GmsOptions(), 1 / 1.2, 10.0),
        (GmsOptions(rotation=True), 1.0, 135.0),
        (GmsOptions(rotation=True), 1.0, 110.0),
        (GmsOptions(zoom=True), 0.6, 0.0),
        (GmsOptions(rotation=True, zoom=True), 0.7, 90.0),
    ],
)
def test_front_end_matches_what_its_options_allow(
    image: NDArray[np.uint8], options: GmsOptions, zoom: float, degrees: float
) -> None:
    n, right = right_share(GmsFrontend(1000, options), image, zoom, degrees)
    assert right > 0.93
    assert n > 150


def test_a_turn_needs_the_rotation_option(image: NDArray[np.uint8]) -> None:
    n, _ = right_share(GmsFrontend(1000), image, 1.0, 135.0)
    n_turning, _ = right_share(GmsFrontend(1000, GmsOptions(rotation=True)), image, 1.0, 135.0)
    assert n < 0.1 * n_turning


def test_few_features_are_matched_on_larger_cells(image: NDArray[np.uint8]) -> None:
    frontend = GmsFrontend(1000)
    a, b = frontend.extract(image), frontend.extract(warped(image, 1.0, 3.0)[0])
    few = a.take(np.arange(0, len(a), 10))
    assert len(frontend.match_wide(few, b)) > 40


def test_pixels_that_lie_beyond_the_rim_are_matched_too(image: NDArray[np.uint8]) -> None:
    """As they do where a rolling shutter was taken out of an image."""
    frontend = GmsFrontend(1000)
    a, b = frontend.extract(image), frontend.extract(warped(image, 1.0, 3.0)[0])
    shifted = [replace(features, uv_px=features.uv_px - (12.0, 40.0)) for features in (a, b)]
    assert min(features.uv_px.min() for features in shifted) < 0
    assert len(frontend.match_wide(*shifted)) > 0.9 * len(frontend.match_wide(a, b))


def test_options_are_those_of_orb_and_its_own() -> None:
    frontend = create_frontend(FrontendConfig(name="gms", options={"rotation": True, "n_octaves": 4}))
    assert isinstance(frontend, GmsFrontend)
    assert frontend.n_octaves == 4
    assert frontend.max_turn_deg == 180
    with pytest.raises(ConfigError, match=r"frontend\.options\.rotate:.*rotation"):
        create_frontend(FrontendConfig(name="gms", options={"rotate": True}))


def no_adjustment(problem: object) -> None:
    raise AssertionError("no start is tried")


@pytest.mark.parametrize("frontend", [OrbFrontend(), GmsFrontend()])
def test_initialiser_takes_any_binary_front_end(frontend: OrbFrontend) -> None:
    Initialiser(frontend, no_adjustment, InitialiserConfig(matching="gms"), np.eye(3), (640, 480), 0)  # type: ignore[arg-type]


def test_other_front_ends_are_refused_by_name() -> None:
    sift = SiftFrontend(100)
    with pytest.raises(ConfigError, match=r"initialiser\.matching: gms.*'sift'.*ratio"):
        Initialiser(sift, no_adjustment, InitialiserConfig(matching="gms"), np.eye(3), (640, 480), 0)  # type: ignore[arg-type]
    features = sift.extract(np.zeros((50, 50), np.uint8))
    with pytest.raises(ConfigError, match="binary"):
        match_by_motion(sift, features, features)


def test_matching_is_one_of_two_words() -> None:
    with pytest.raises(ValueError, match="'ratio' or 'gms'"):
        Config.model_validate({"initialiser": {"matching": "GMS"}})


@pytest.mark.parametrize("step_m", [[0.1, 0, 0], [0.0, 0.03, 0.25]], ids=["sideways", "ahead"])
def test_start_from_motion_statistics_is_right(step_m: FloatArray) -> None:
    from dualslam.backend.local_ba import bundle_adjust_arrays

    world = PointWorld(cloud(1500, seed=2), path(30, np.array(step_m), np.zeros(3)), seed=2)
    config = InitialiserConfig(matching="gms")
    starter = Initialiser(OrbFrontend(), bundle_adjust_arrays, config, CAMERA.K, SIZE_PX, 0)
    start = next(start for start in map(starter.add, world.views()) if start)
    T_true = world.T_world_cam[[view.index for view in start.views]]  # type: ignore[union-attr]
    translation, rotation = pose_errors(start.T_first_cam, T_true)  # type: ignore[union-attr]
    assert rotation.max() < 0.01
    assert translation.max() < 0.03 * np.linalg.norm(T_true[-1, :3, 3] - T_true[0, :3, 3])
