"""The ORB front end: how many corners, where, how repeatable, and what it does with bad images."""

from __future__ import annotations

import pickle

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dualslam.core.errors import InputError
from dualslam.core.types import Features, FloatArray
from dualslam.frontends.features.orb import OrbFrontend, OrbOptions
from tests.frontends.conftest import textured

Image = NDArray[np.uint8]


def same(a: Features, b: Features) -> bool:
    """Whether two sets of features are equal bit for bit."""
    names = ("uv_px", "uv_rect_px", "sigma_px", "scale", "octave", "angle_rad", "descriptors")
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in names)


def warped(image: Image, scale: float, degrees: float) -> tuple[Image, FloatArray]:
    """The image turned and scaled about its middle and shifted a little, and the (2, 3) map of its pixels."""
    height, width = image.shape
    affine = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), degrees, scale)
    affine[:, 2] += (2.37, -1.61)
    if scale < 0.9:  # antialias, as a camera would
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), 0.5 * np.sqrt(1 / scale**2 - 1)), np.uint8)
    return np.asarray(cv2.warpAffine(image, affine, (width, height), flags=cv2.INTER_CUBIC), np.uint8), affine


def test_counts_shapes_and_types(image: Image) -> None:
    features = OrbFrontend(1000).extract(image)
    assert len(features) == 1000
    assert features.descriptors.shape == (1000, 32)
    assert features.descriptors.dtype == np.uint8
    assert features.octave.dtype == np.int64
    assert features.uv_px.dtype == features.sigma_px.dtype == features.angle_rad.dtype == np.float64
    np.testing.assert_allclose(features.scale, 1.2**features.octave)
    np.testing.assert_array_equal(features.uv_rect_px, features.uv_px)
    assert set(features.octave) == set(range(8))
    assert ((features.uv_px >= 0) & (features.uv_px <= (639, 479))).all()
    sigma = np.round(features.sigma_px / features.scale, 9)
    assert set(sigma) == {0.45, 0.65, 1.5}
    assert (sigma == 1.5).mean() < 0.1


def test_same_image_gives_same_features_whatever_the_threads(image: Image) -> None:
    before = cv2.getNumThreads()
    try:
        results = []
        for threads in (1, 2, 4):
            cv2.setNumThreads(threads)
            results.append(OrbFrontend(800).extract(image))
    finally:
        cv2.setNumThreads(before)
    assert same(results[0], results[1])
    assert same(results[0], results[2])


def test_colour_is_converted_once_and_strided_views_are_accepted(image: Image) -> None:
    grey = OrbFrontend(300).extract(image)
    assert same(grey, OrbFrontend(300).extract(np.repeat(image[:, :, None], 3, axis=2)))
    mirrored = image[:, ::-1]
    assert same(OrbFrontend(300).extract(mirrored), OrbFrontend(300).extract(mirrored.copy()))


def test_input_is_left_alone(image: Image) -> None:
    copy = image.copy()
    OrbFrontend(300).extract(copy)
    np.testing.assert_array_equal(copy, image)


@pytest.mark.parametrize("shape", [(1, 1), (1, 500), (500, 1), (7, 7), (31, 31), (32, 32), (33, 33), (40, 640)])
def test_tiny_images_are_no_error(shape: tuple[int, int]) -> None:
    features = OrbFrontend(500).extract(np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8))
    assert features.descriptors.shape == (len(features), 32)
    if min(shape) <= 32:
        assert len(features) == 0


@pytest.mark.parametrize("grey", [0, 128, 255])
def test_flat_images_have_no_features(grey: int) -> None:
    features = OrbFrontend(500).extract(np.full((240, 320), grey, np.uint8))
    assert len(features) == 0
    assert features.descriptors.shape == (0, 32)
    assert features.descriptors.dtype == np.uint8
    assert features.octave.dtype == np.int64


@pytest.mark.parametrize("bad", [np.zeros((4, 4)), np.zeros((4, 4, 4), np.uint8), np.zeros((0, 5), np.uint8)])
def test_what_is_no_image_is_an_input_error(bad: Image) -> None:
    with pytest.raises(InputError, match="uint8"):
        OrbFrontend().extract(bad)


def test_corners_cover_the_image(image: Image) -> None:
    uv = OrbFrontend(1000).extract(image).uv_px
    counts = np.histogram2d(uv[:, 1], uv[:, 0], bins=(6, 8), range=((0, 480), (0, 640)))[0]
    assert counts.min() >= 3
    assert counts.max() <= 5 * 1000 / 48


def test_weak_half_of_an_image_still_gets_corners(image: Image) -> None:
    faint = image.copy()
    faint[:, :320] = 128 + (faint[:, :320].astype(np.int64) - 128) // 8
    uv = OrbFrontend(1000).extract(faint).uv_px
    assert (uv[:, 0] < 310).sum() >= 250


def test_blurred_image_still_gives_most_of_the_corners(image: Image) -> None:
    blurred = np.asarray(cv2.GaussianBlur(image, (0, 0), 3.0), np.uint8)
    assert len(OrbFrontend(1000).extract(blurred)) >= 700


@pytest.mark.parametrize("blur_px", [4.0, 6.0, 8.0])
def test_what_a_soft_and_noisy_image_has_is_of_the_scene(image: Image, blur_px: float) -> None:
    # The same soft image twice, each with its own noise: what is found in one must be where it was in the other. (Of
    # corners that need not stand out from the noise half are off by 1.3 to 3.8 pixels of their octave, or missing.)
    rng = np.random.default_rng(4)
    soft = cv2.GaussianBlur(image, (0, 0), blur_px).astype(float)
    noisy = [np.clip(np.rint(soft + 2.0 * rng.standard_normal(soft.shape)), 0, 255).astype(np.uint8) for _ in range(2)]
    a, b = (OrbFrontend(1000).extract(each) for each in noisy)
    by_octave = [np.column_stack([each.uv_px, 20.0 * each.octave]) for each in (a, b)]
    distance, _ = cKDTree(by_octave[1]).query(by_octave[0])
    assert len(a) >= 150
    assert np.median(distance / a.scale) < 0.3


@pytest.mark.parametrize(
    ("scale", "degrees"), [(1.0, 0.0), (1.0, 30.0), (1.0, -90.0), (1 / 1.2, 10.0), (1 / 1.2**3, 0.0)]
)
def test_features_come_back_in_a_turned_and_scaled_image(image: Image, scale: float, degrees: float) -> None:
    frontend = OrbFrontend(1000)
    other, affine = warped(image, scale, degrees)
    a, b = frontend.extract(image), frontend.extract(other)
    matches = frontend.match_wide(a, b)
    first, second = matches.index.T
    error = b.uv_px[second] - (a.uv_px[first] @ affine[:, :2].T + affine[:, 2])
    right = np.hypot(*error.T) < 3 * a.scale[first]
    assert len(matches) >= 120
    assert right.mean() >= 0.95
    # Accurate: the median is a fraction of a pixel of the octave.
    assert np.median(np.abs(error[right]) / a.scale[first[right], None]) < 0.3
    # Turned as the image was (OpenCV's positive angle is anticlockwise, ours clockwise).
    turn = np.angle(np.exp(1j * (b.angle_rad[second] - a.angle_rad[first] + np.radians(degrees))))
    assert np.abs(np.median(turn[right])) < np.radians(3)
    octaves = a.octave[first[right]] - b.octave[second[right]]
    assert np.abs(np.median(octaves) + np.log(scale) / np.log(1.2)) <= 0.5


def test_no_bias_between_octaves(image: Image) -> None:
    # One scene point seen in two octaves: an image and the same one shrunk. A half-pixel error of the mapping between
    # levels would displace all of them together, by (1 - scale) / 2.
    frontend = OrbFrontend(2000)
    small_size = (444, 333)
    small = np.asarray(cv2.resize(image, small_size, interpolation=cv2.INTER_AREA), np.uint8)
    a, b = frontend.extract(image), frontend.extract(small)
    ratio = np.array([444 / 640, 333 / 480])
    predicted = (a.uv_px + 0.5) * ratio - 0.5
    for octave in range(2, 7):
        rows = np.flatnonzero(a.octave == octave)
        others = np.flatnonzero(b.octave == octave - 2)
        distance, nearest = cKDTree(b.uv_px[others]).query(predicted[rows])
        close = distance < 1.5 * a.scale[rows] * ratio[0]
        error = (b.uv_px[others[nearest]] - predicted[rows])[close] / (a.scale[rows[close], None] * ratio)
        assert close.sum() > 30
        assert np.abs(np.median(error, axis=0)).max() < 0.06


def test_positions_within_one_image_agree_across_octaves() -> None:
    # Isolated blobs: every octave that sees one must put it at the same place.
    image = np.full((300, 400), 60, np.uint8)
    truth = np.array([(u, v) for v in range(60, 250, 60) for u in range(60, 350, 60)], np.float64)
    for u, v in truth.astype(int).tolist():
        cv2.circle(image, (u, v), 7, 200, -1, cv2.LINE_AA)
    features = OrbFrontend(1000).extract(image)
    distance, nearest = cKDTree(truth).query(features.uv_px)
    central = (distance < 4.0) & (features.octave >= 5)
    offset = features.uv_px[central] - truth[nearest[central]]
    assert central.sum() >= 10
    assert np.abs(offset.mean(axis=0)).max() < 0.35


def test_distance_counts_bits() -> None:
    rng = np.random.default_rng(3)
    a, b = rng.integers(0, 256, (2, 50, 32), dtype=np.uint8)
    expected = np.unpackbits(a ^ b, axis=1).sum(axis=1)
    np.testing.assert_array_equal(OrbFrontend().distance(a, b), expected)
    ones, zeros = np.full((1, 32), 255, np.uint8), np.zeros((1, 32), np.uint8)
    assert OrbFrontend().distance(ones, zeros) == 256
    assert OrbFrontend().distance(a[:0], b[:0]).shape == (0,)


def test_match_wide_agrees_with_opencv(image: Image) -> None:
    frontend = OrbFrontend(600, OrbOptions(max_distance_strict=256))
    a, b = frontend.extract(image), frontend.extract(warped(image, 1.0, 5.0)[0])
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(a.descriptors, b.descriptors, k=2)
    back = cv2.BFMatcher(cv2.NORM_HAMMING).match(b.descriptors, a.descriptors)
    expected = {
        (best.queryIdx, best.trainIdx)
        for best, second in pairs
        if best.distance <= 0.85 * second.distance and back[best.trainIdx].trainIdx == best.queryIdx
    }
    ours = {tuple(row) for row in frontend.match_wide(a, b).index.tolist()}
    assert ours <= expected
    assert len(ours) >= 0.9 * len(expected)  # the rotation check removes some


def test_match_wide_with_nothing_to_match(image: Image) -> None:
    frontend = OrbFrontend(100)
    some, none = frontend.extract(image), frontend.extract(np.zeros((5, 5), np.uint8))
    for a, b in ((some, none), (none, some), (none, none)):
        matches = frontend.match_wide(a, b)
        assert matches.index.shape == (0, 2)
        assert len(matches.distance) == 0


def test_can_be_sent_to_another_process(image: Image) -> None:
    frontend = OrbFrontend(200)
    assert same(frontend.extract(image), pickle.loads(pickle.dumps(frontend)).extract(image))


def test_extremes_of_the_options() -> None:
    image = textured(200, 300, seed=4)
    for options in (
        OrbOptions(n_octaves=1),
        OrbOptions(scale_factor=2.0, n_octaves=16),
        OrbOptions(fast_thresholds=(40,)),
    ):
        features = OrbFrontend(50, options).extract(image)
        assert len(features) == 50
        assert features.octave.max() < options.n_octaves
