"""The SIFT front end: how many extrema, where, how repeatable, and what it does with bad images."""

from __future__ import annotations

import pickle

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dualslam.core.config.settings import FrontendConfig
from dualslam.core.errors import ConfigError, InputError
from dualslam.frontends.features.sift import SiftFrontend, SiftOptions
from dualslam.frontends.registry import create_frontend
from tests.frontends.conftest import textured
from tests.frontends.features.test_orb import same, warped

Image = NDArray[np.uint8]


def test_is_found_by_its_name_and_takes_its_options() -> None:
    frontend = create_frontend(FrontendConfig(name="sift", n_features=77, options={"levels_per_doubling": 4}))
    assert isinstance(frontend, SiftFrontend)
    assert frontend.n_features == 77
    assert frontend.scale_factor == pytest.approx(2**0.25)
    with pytest.raises(ConfigError, match=r"frontend\.options\.contrast:.*contrast_threshold"):
        create_frontend(FrontendConfig(name="sift", options={"contrast": 0.1}))


def test_counts_shapes_and_types(image: Image) -> None:
    features = SiftFrontend(800).extract(image)
    assert len(features) == 800
    assert features.descriptors.shape == (800, 128)
    assert features.descriptors.dtype == np.uint8
    assert features.octave.dtype == np.int64
    assert (np.diff(features.octave) >= 0).all()
    assert features.octave.min() == 0
    assert features.octave.max() <= 9
    # The scale is continuous, the octave its nearest level.
    level = np.log(features.scale) / np.log(2 ** (1 / 3))
    assert np.abs(level - features.octave).max() < 0.51
    assert np.median(np.abs(level - features.octave)) > 0.05
    assert ((features.uv_px >= 0) & (features.uv_px <= (639, 479))).all()


def test_descriptors_are_unit_vectors_and_distances_theirs(image: Image) -> None:
    frontend = SiftFrontend(400)
    descriptors = frontend.extract(image).descriptors
    unit = descriptors.astype(np.float64) / 512
    np.testing.assert_allclose(np.linalg.norm(unit, axis=1), 1.0, atol=0.01)
    a, b = descriptors[:-1], descriptors[1:]
    np.testing.assert_allclose(frontend.distance(a, b), np.linalg.norm(unit[:-1] - unit[1:], axis=1), rtol=1e-6)
    assert frontend.distance(a[:0], b[:0]).shape == (0,)
    assert (frontend.distance(a, a) == 0).all()


def test_extrema_cover_the_image(image: Image) -> None:
    uv = SiftFrontend(800).extract(image).uv_px
    counts = np.histogram2d(uv[:, 1], uv[:, 0], bins=(6, 8), range=((0, 480), (0, 640)))[0]
    assert counts.min() >= 4
    faint = image.copy()
    faint[:, :320] = 128 + (faint[:, :320].astype(np.int64) - 128) // 8
    uv = SiftFrontend(800).extract(faint).uv_px
    assert (uv[:, 0] < 310).sum() >= 150


@pytest.mark.parametrize(
    ("scale", "degrees"), [(1.0, 0.0), (1.0, 30.0), (1.0, -90.0), (1 / 1.2, 10.0), (0.5, 0.0), (1.3, 45.0)]
)
def test_features_come_back_in_a_turned_and_scaled_image(image: Image, scale: float, degrees: float) -> None:
    frontend = SiftFrontend(1000)
    other, affine = warped(image, scale, degrees)
    a, b = frontend.extract(image), frontend.extract(other)
    matches = frontend.match_wide(a, b)
    first, second = matches.index.T
    error = b.uv_px[second] - (a.uv_px[first] @ affine[:, :2].T + affine[:, 2])
    right = np.hypot(*error.T) < 3 * a.scale[first]
    assert len(matches) >= 120
    assert right.mean() >= 0.97
    assert np.abs(np.median(error[right], axis=0)).max() < 0.05
    turn = np.angle(np.exp(1j * (b.angle_rad[second] - a.angle_rad[first] + np.radians(degrees))))
    assert np.abs(np.median(turn[right])) < np.radians(1)
    growth = b.scale[second[right]] / a.scale[first[right]]
    assert np.median(growth) == pytest.approx(scale, rel=0.03)


def test_match_wide_agrees_with_opencv(image: Image) -> None:
    frontend = SiftFrontend(600, SiftOptions(max_distance_strict=1.5))
    a, b = frontend.extract(image), frontend.extract(warped(image, 1.0, 5.0)[0])
    wide_a, wide_b = a.descriptors.astype(np.float32), b.descriptors.astype(np.float32)
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(wide_a, wide_b, k=2)
    back = cv2.BFMatcher(cv2.NORM_L2).match(wide_b, wide_a)
    expected = {
        (best.queryIdx, best.trainIdx)
        for best, second in pairs
        if best.distance <= 0.8 * second.distance and back[best.trainIdx].trainIdx == best.queryIdx
    }
    matches = frontend.match_wide(a, b)
    ours = {tuple(row) for row in matches.index.tolist()}
    assert ours <= expected
    assert len(ours) >= 0.9 * len(expected)  # the rotation check removes some
    distance = frontend.distance(a.descriptors[matches.index[:, 0]], b.descriptors[matches.index[:, 1]])
    np.testing.assert_allclose(matches.distance, distance, rtol=1e-6)


def test_same_image_gives_same_features_whatever_the_threads(image: Image) -> None:
    before = cv2.getNumThreads()
    try:
        results = []
        for threads in (1, 3):
            cv2.setNumThreads(threads)
            results.append(SiftFrontend(500).extract(image))
    finally:
        cv2.setNumThreads(before)
    assert same(*results)
    assert same(results[0], pickle.loads(pickle.dumps(SiftFrontend(500))).extract(image))


@pytest.mark.parametrize("shape", [(1, 1), (1, 500), (500, 1), (7, 7), (15, 15), (16, 16), (17, 33), (40, 640)])
def test_tiny_images_are_no_error(shape: tuple[int, int]) -> None:
    features = SiftFrontend(500).extract(np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8))
    assert features.descriptors.shape == (len(features), 128)
    if min(shape) < 16:
        assert len(features) == 0


def test_flat_images_have_no_features() -> None:
    features = SiftFrontend(500).extract(np.full((240, 320, 3), 128, np.uint8))
    assert len(features) == 0
    assert features.descriptors.dtype == np.uint8
    assert features.octave.dtype == np.int64
    assert features.uv_px.shape == (0, 2)


def test_what_is_no_image_is_an_input_error() -> None:
    with pytest.raises(InputError, match="uint8"):
        SiftFrontend().extract(np.zeros((4, 4, 4), np.uint8))


def test_match_wide_with_nothing_to_match(image: Image) -> None:
    frontend = SiftFrontend(100)
    some, none = frontend.extract(image), frontend.extract(np.zeros((5, 5), np.uint8))
    for a, b in ((some, none), (none, some), (none, none)):
        assert frontend.match_wide(a, b).index.shape == (0, 2)


def test_extremes_of_the_options() -> None:
    image = textured(200, 300, seed=4)
    for options in (SiftOptions(n_octaves=1), SiftOptions(levels_per_doubling=8, n_octaves=32)):
        features = SiftFrontend(50, options).extract(image)
        assert len(features) == 50
        assert features.octave.max() < options.n_octaves
