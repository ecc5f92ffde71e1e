"""Checks of what a front end says of itself and of what it finds in an image."""

from __future__ import annotations

import os
import pickle
import random
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.conformance import expect
from dualslam.core.errors import ConfigError, InputError
from dualslam.core.types import Features, FloatArray
from dualslam.frontends.conformance.scene import FEATURES_ARRAYS, PrintedPlane, Subject, same_features

TINY = ((1, 1), (1, 300), (300, 1), (7, 7), (16, 16), (33, 33), (20, 300))
"""Heights and widths."""
MAX_BIAS_PX = 0.1
"""A fifth of the half pixel by which wrong conventions err, in pixels of the octave."""


def check_declarations(subject: Subject) -> None:
    """The attributes of the protocol are there and make sense."""
    frontend = subject.make()
    expect(isinstance(frontend.name, str) and frontend.name != "", "name is no word")
    expect(frontend.scale_factor > 1, f"scale_factor is {frontend.scale_factor}: not above 1")
    expect(isinstance(frontend.n_octaves, int) and frontend.n_octaves >= 1, f"n_octaves is {frontend.n_octaves!r}")
    limits = 0 < frontend.max_distance_strict <= frontend.max_distance
    expect(limits, f"0 < {frontend.max_distance_strict} <= {frontend.max_distance} does not hold for max_distance")
    expect(0 <= frontend.max_turn_deg <= 180, f"max_turn_deg is {frontend.max_turn_deg}")
    expect(frontend.max_zoom >= 1, f"max_zoom is {frontend.max_zoom}: below 1")


def check_wrong_option_is_named(subject: Subject) -> None:
    """An option that does not exist is a ConfigError that names it."""
    try:
        subject.factory.from_options(100, {**subject.options, "no_such_option": 1})
    except ConfigError as error:
        expect("no_such_option" in str(error), f"the ConfigError does not name the option: {error}")
    else:
        expect(False, "from_options took an option called 'no_such_option'")


def check_shapes_and_types(subject: Subject) -> None:
    """Arrays of one length, of the types of `Features`, finite, and within what was declared."""
    frontend, image = subject.make(), subject.image()
    features = frontend.extract(image)
    _expect_well_formed(features, len(features))
    height, width = image.shape
    inside = (features.uv_px >= -0.5).all() and (features.uv_px <= (width - 0.5, height - 0.5)).all()
    expect(inside, "there are features outside the image")
    expect(np.array_equal(features.uv_px, features.uv_rect_px), "uv_rect_px differs from uv_px: the caller rectifies")
    in_range = features.octave.min() >= 0 and features.octave.max() < frontend.n_octaves
    expect(in_range, f"octaves from {features.octave.min()} to {features.octave.max()}, n_octaves {frontend.n_octaves}")
    expect(features.scale.min() >= 1, f"a scale is {features.scale.min()}: below 1, which is the finest")
    off = np.abs(np.log(features.scale) / np.log(frontend.scale_factor) - features.octave)
    expect(off.max() < 0.75, f"a scale is {off.max():.2f} octaves away from scale_factor ** octave")
    expect(features.sigma_px.min() > 0, "a sigma_px is not positive")
    expect((np.abs(features.angle_rad) <= 2 * np.pi).all(), "an angle_rad is more than a turn: degrees?")


def check_number_and_spread(subject: Subject) -> None:
    """As many as were asked for and no more, and not all in one place."""
    image = subject.image()
    height, width = image.shape
    for n in (60, 400):
        uv = subject.make(n).extract(image).uv_px
        expect(n / 2 <= len(uv) <= n, f"{len(uv)} features where {n} were asked for")
    counts, _, _ = np.histogram2d(uv[:, 0], uv[:, 1], bins=3, range=((0, width), (0, height)))
    expect(counts.min() >= 0.02 * len(uv), f"a ninth of the image has {counts.min():.0f} of {len(uv)} features")


def check_flat_and_tiny_images(subject: Subject) -> None:
    """They are no error, and a set without features has the arrays of any other."""
    frontend = subject.make()
    usual = frontend.extract(subject.image())
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, shape, dtype=np.uint8) for shape in TINY]
    images += [np.full((240, 320), grey, np.uint8) for grey in (0, 128, 255)]
    for image in images:
        features = frontend.extract(image)
        what = f"in an image of {image.shape[1]}x{image.shape[0]}"
        _expect_well_formed(features, len(features), what)
        same = features.descriptors.shape[1:] == usual.descriptors.shape[1:]
        expect(same and features.descriptors.dtype == usual.descriptors.dtype, f"other descriptors {what}")
        for a, b in ((features, usual), (usual, features), (features, features)):
            frontend.match_wide(a, b)
    expect(len(features) == 0, "there are features in a white image")


def check_what_is_no_image(subject: Subject) -> None:
    """It is an InputError."""
    frontend = subject.make()
    for bad in (np.zeros((40, 40)), np.zeros((40, 40, 4), np.uint8), np.zeros((0, 40), np.uint8)):
        try:
            frontend.extract(bad.view() if bad.dtype == np.uint8 else bad)  # type: ignore[arg-type]
        except InputError:
            continue
        expect(False, f"an array {bad.shape} {bad.dtype} was taken for an image")


def check_colour_and_memory_layout(subject: Subject) -> None:
    """Colour images, views with strides and read-only images are taken, and left as they are."""
    frontend, image = subject.make(), subject.image()
    features = frontend.extract(image)
    _expect_well_formed(frontend.extract(np.repeat(image[:, :, None], 3, axis=2)), None, "in a colour image")
    strided = np.repeat(image, 2, axis=1)[:, ::2]
    expect(same_features(frontend.extract(strided), features), "a view with strides gives other features")
    locked = image.copy()
    locked.setflags(write=False)
    expect(same_features(frontend.extract(locked), features), "a read-only image gives other features")
    copy = image.copy()
    frontend.extract(copy)
    expect(np.array_equal(copy, image), "extract writes to the image that it is given")


def check_same_image_same_features(subject: Subject) -> None:
    """Bit for bit: again, after another image, beside it, in another instance, after a trip to another process."""
    frontend, image = subject.make(), subject.image()
    features = frontend.extract(image)
    frontend.extract(subject.scene(2).photograph()[:200, :300])
    expect(same_features(frontend.extract(image), features), "the second time, other features")
    with ThreadPoolExecutor(2) as threads:
        beside = list(threads.map(frontend.extract, [image, subject.scene(2).photograph(), image, image]))
    same = all(same_features(beside[i], features) for i in (0, 2, 3))
    expect(same, "other features while another thread asks for an image's")
    expect(same_features(subject.make().extract(image), features), "another instance finds other features")
    sent: object = pickle.loads(pickle.dumps(frontend))
    expect(same_features(sent.extract(image), features), "after pickling, other features")  # type: ignore[attr-defined]
    matches = [
        each.match_wide(features, features.take(np.arange(100))) for each in (frontend, frontend, subject.make())
    ]
    same = all(np.array_equal(each.index, matches[0].index) for each in matches)
    expect(same, "the same features are matched differently the second time")


def check_no_global_state(subject: Subject) -> None:
    """Random generators, numpy's error handling, OpenCV's threads and the environment are left alone."""

    def state() -> tuple[object, ...]:
        legacy = np.random.get_state(legacy=True)  # noqa: NPY002
        return str(legacy), random.getstate(), np.geterr(), cv2.getNumThreads(), dict(os.environ), os.getcwd()

    image = subject.image()
    before = state()
    frontend = subject.make()
    features = frontend.extract(image)
    frontend.match_wide(features, features)
    for name, old, new in zip(
        ("numpy.random", "random", "numpy.seterr", "cv2's threads", "os.environ", "the working directory"),
        before,
        state(),
        strict=True,
    ):
        expect(old == new, f"{name} is changed")


def check_pixel_centres_by_mirroring(subject: Subject) -> None:
    """Pixel (0, 0) is the centre of the top-left pixel: a mirrored image has its features at mirrored places."""
    frontend, image = subject.make(), subject.image()
    features = frontend.extract(image)
    for axis, name in ((0, "u"), (1, "v")):
        mirrored = frontend.extract(np.ascontiguousarray(np.flip(image, 1 - axis)))
        uv = mirrored.uv_px.copy()
        uv[:, axis] = image.shape[1 - axis] - 1 - uv[:, axis]
        offset, scale = _nearest_offsets(features, uv, mirrored.octave)
        expect(len(offset) >= 0.3 * len(features), f"only {len(offset)} of {len(features)} features stay when mirrored")
        # A bias moves both the same way, so that it shows twice.
        for part, which in (("fine", scale <= np.median(scale)), ("coarse", scale >= np.median(scale))):
            bias = float(np.median(offset[which, axis] / scale[which])) / 2
            expect(abs(bias) < MAX_BIAS_PX, f"{part} features are off by {bias:.2f} px of their octave in {name}")


def check_pixel_centres_by_discs(subject: Subject) -> None:
    """Discs at known places between the pixels: what is found at them is, on average, about their centres."""
    # A spacing that no pyramid divides: at 48, all discs would meet the pixels of a level 1.2 times smaller alike, and
    # one side of each would be the sharper one.
    radius_px, spacing = 5.0, 47
    grid = np.stack(np.meshgrid(np.arange(40, 440, spacing), np.arange(40, 320, spacing)), axis=-1).reshape(-1, 2)
    centres = grid + np.random.default_rng(5).uniform(-0.5, 0.5, grid.shape)
    features = subject.make().extract(PrintedPlane.of_discs(centres, radius_px, (480, 360)).photograph(noise=1.0))
    step = features.uv_px[:, None] - centres[None]
    nearest = np.hypot(*np.moveaxis(step, 2, 0)).argmin(axis=1)
    offset = step[np.arange(len(nearest)), nearest]
    at_disc = np.hypot(*offset.T) < 2 * radius_px
    # One vote for each disc: the mean of what is found at it, which may be its centre or places all about its rim.
    discs = np.unique(nearest[at_disc])
    votes = np.array([offset[at_disc & (nearest == disc)].mean(axis=0) for disc in discs]).reshape(-1, 2)
    expect(len(discs) >= len(centres) / 2, f"nothing is found at {len(centres) - len(discs)} of {len(centres)} discs")
    error = np.abs(np.median(votes, axis=0)).max()
    expect(error < 2.5 * MAX_BIAS_PX, f"discs are found {error:.2f} px beside their centres")


def _nearest_offsets(features: Features, uv_px: FloatArray, octave: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
    """Offsets (N, 2) from features to the nearest place of their octave, if that is near, and the features' scales."""
    step = uv_px[None] - features.uv_px[:, None]
    distance = np.hypot(step[..., 0], step[..., 1])
    distance[features.octave[:, None] != octave[None]] = np.inf
    nearest = distance.argmin(axis=1)
    rows = np.arange(len(nearest))
    close = distance[rows, nearest] < 1.5 * features.scale
    return step[rows, nearest][close], features.scale[close]


def _expect_well_formed(features: Features, n: int | None, where: str = "") -> None:
    """Types and lengths of the arrays."""
    n = len(features) if n is None else n
    shapes = {"uv_px": (n, 2), "uv_rect_px": (n, 2), "sigma_px": (n,), "scale": (n,), "octave": (n,), "angle_rad": (n,)}
    for name in FEATURES_ARRAYS:
        array = getattr(features, name)
        expect(isinstance(array, np.ndarray), f"{name} is a {type(array).__name__}, not a numpy array {where}")
        if name == "descriptors":
            fit = array.ndim == 2 and len(array) == n and array.dtype != np.object_
            expect(fit, f"descriptors are {array.shape} {array.dtype}, not one row of numbers for each feature {where}")
            continue
        expect(array.shape == shapes[name], f"{name} is {array.shape}, not {shapes[name]} {where}")
        dtype = np.int64 if name == "octave" else np.float64
        expect(array.dtype == dtype, f"{name} is {array.dtype}, not {np.dtype(dtype)} {where}")
        expect(np.isfinite(array).all(), f"{name} has a number that is not finite {where}")


CHECKS: tuple[Callable[[Subject], None], ...] = (
    check_declarations,
    check_wrong_option_is_named,
    check_shapes_and_types,
    check_number_and_spread,
    check_flat_and_tiny_images,
    check_what_is_no_image,
    check_colour_and_memory_layout,
    check_same_image_same_features,
    check_no_global_state,
    check_pixel_centres_by_mirroring,
    check_pixel_centres_by_discs,
)
