"""Choosing and placing corners on one level."""

from __future__ import annotations

import numpy as np
import pytest

from dualslam.frontends.features.corners import (
    detect_corners,
    find_peaks,
    refine_corners,
    select_spread,
    share_out,
    stand_out,
)
from tests.frontends.conftest import textured


def test_share_out_fills_what_poor_levels_leave() -> None:
    weights = np.array([4.0, 2.0, 1.0, 1.0])
    assert share_out([1000, 1000, 1000, 1000], weights, 80) == [40, 20, 10, 10]
    assert share_out([5, 1000, 0, 1000], weights, 80)[0] == 5
    assert sum(share_out([5, 1000, 0, 1000], weights, 80)) == 80
    assert share_out([1, 2, 3, 4], weights, 80) == [1, 2, 3, 4]
    assert share_out([0, 0], weights[:2], 80) == [0, 0]
    assert sum(share_out([1000] * 4, weights, 3)) == 3


@pytest.mark.parametrize("n_wanted", [0, 1, 50, 500, 10_000])
def test_select_spread_counts(n_wanted: int) -> None:
    rng = np.random.default_rng(0)
    xy, response = rng.integers(16, 600, (3000, 2)), rng.integers(1, 256, 3000).astype(float)
    given = np.asfortranarray(xy)
    rows = select_spread(given, response, n_wanted)
    assert len(rows) == min(n_wanted, 3000)
    assert (np.diff(rows) > 0).all()
    np.testing.assert_array_equal(given, xy)


def test_select_spread_takes_the_strongest_of_a_crowd_and_the_lonely() -> None:
    crowd = np.stack([np.arange(100) % 10, np.arange(100) // 10], axis=1)
    xy = np.concatenate([crowd, [[300, 300]]])
    response = np.concatenate([np.arange(100) + 50.0, [7.0]])
    assert select_spread(xy, response, 2).tolist() == [99, 100]


def test_detect_corners_keeps_the_rim_free_and_lowers_the_threshold_only_where_it_must() -> None:
    image = textured(150, 201, seed=1)
    image[:, :100] = 128 + (image[:, :100].astype(np.int64) - 128) // 8
    high, high_response = detect_corners(image, (20,), 16, 32)
    both, response = detect_corners(image, (20, 5), 16, 32)
    assert (both >= 16).all()
    assert (both < (201 - 16, 150 - 16)).all()
    np.testing.assert_array_equal(both[: len(high)], high)
    np.testing.assert_array_equal(response[: len(high)], high_response)
    added = (both[len(high) :] - 16) // 32
    assert len(added) > 20
    assert not {tuple(c) for c in added.tolist()} & {tuple(c) for c in ((high - 16) // 32).tolist()}
    assert len(np.unique(both, axis=0)) == len(both)


def test_refine_finds_the_centre_of_a_blob() -> None:
    rng = np.random.default_rng(2)
    truth = rng.uniform(-1.2, 1.2, (200, 2))
    v, u = np.mgrid[-15:16, -15:16]
    squared = (u - truth[:, 0, None, None]) ** 2 + (v - truth[:, 1, None, None]) ** 2
    for amplitude in (150.0, -100.0):
        patches = np.rint(105 + amplitude * np.exp(-squared / (2 * 1.5**2))).astype(np.uint8)
        offset, found = refine_corners(find_peaks(patches))
        assert found.all()
        assert np.abs(offset - truth).max() < 0.08


def test_refine_stays_where_there_is_nothing() -> None:
    ramp = np.tile(np.arange(31, dtype=np.uint8) * 5, (1, 31, 1))
    for patches in (np.zeros((3, 31, 31), np.uint8), ramp, np.empty((0, 31, 31), np.uint8)):
        offset, found = refine_corners(find_peaks(patches))
        assert not found.any()
        assert (offset == 0).all()


def test_corners_of_noise_do_not_stand_out_and_those_of_the_scene_do() -> None:
    rng = np.random.default_rng(5)
    noise = np.clip(np.rint(120 + 2.0 * rng.standard_normal((480, 640))), 0, 255).astype(np.uint8)
    xy, _ = detect_corners(noise, (4,), 16, 32)
    of_noise = np.array([noise[y - 15 : y + 16, x - 15 : x + 16] for x, y in xy.tolist()])
    assert len(of_noise) > 200
    assert stand_out(find_peaks(of_noise), np.full(len(of_noise), 2.0)).mean() < 0.06
    v, u = np.mgrid[-15:16, -15:16]
    grain = 2.0 * rng.standard_normal((200, 31, 31))
    blobs = np.rint(100 + 60 * np.exp(-(u**2 + v**2) / (2 * 1.5**2)) + grain).astype(np.uint8)
    assert stand_out(find_peaks(blobs), np.full(200, 2.0)).all()
    # An edge is no place: along it noise decides.
    edges = np.rint(np.where(u > 0, 160, 80) + grain).astype(np.uint8)
    assert stand_out(find_peaks(edges), np.full(200, 2.0)).mean() < 0.06
    assert stand_out(find_peaks(blobs[:0]), np.empty(0)).shape == (0,)
