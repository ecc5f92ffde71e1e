"""Where the motion of the last frames leads, whatever the stamps of the frames are."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from dualslam.core.geometry import se3
from dualslam.core.types import Features, Track, View
from dualslam.frontends.tracking.motion import Motion
from dualslam.testing.point_world import make_features

RATE_HZ = 30.0
XI = np.array([0.0, 0.02, 0.0, 0.01, 0.0, 0.0])
"""Of a camera, from each frame to the next."""
NO_FEATURES = make_features(np.empty((0, 2)), np.empty(0), np.empty(0, np.int64), np.empty((0, 32), np.uint8))


def track(i: int, stamp_s: float, features: Features = NO_FEATURES) -> Track:
    T, none = se3.exp(i * XI), np.zeros(0, np.int64)
    ids = np.arange(len(features))
    return Track(View(i, stamp_s, features), T, T, ids, none, 0, 0, 1.0, False, np.zeros((6, 6)))


def image(i: int) -> Features:
    """Return an image's features, each of which moves by a pixel from one image to the next."""
    uv_px = np.column_stack([np.arange(20.0) * 10 + i, np.full(20, 50.0)])
    return make_features(uv_px, np.zeros(20), np.zeros(20, np.int64), np.zeros((20, 32), np.uint8))


def ahead(frames: list[int], stamps_s: list[float]) -> float:
    """How many motions from the last frame but one the last of these is expected, after a start at the first."""
    tracks = [track(i, stamp_s) for i, stamp_s in zip(frames, stamps_s, strict=True)]
    motion = Motion(interval_s=0.1)
    for before, after in pairwise(tracks[:-1]):
        motion = motion.next(before, after)
    T = motion.predict(tracks[-2], tracks[-1].view.timestamp_s)
    return float(se3.log(T @ se3.inverse(tracks[-2].T_cam_submap)) @ XI / (XI @ XI))


@pytest.mark.parametrize("direction", [1.0, -1.0])
@pytest.mark.parametrize("late_by", [0.97, 0.999, 1.0])
def test_a_frame_that_is_stamped_when_the_next_one_comes_does_not_fling_the_camera(
    late_by: float, direction: float
) -> None:
    stamps = np.arange(8.0)
    stamps[5] += late_by
    stamps_s = (direction * stamps / RATE_HZ).tolist()
    assert ahead(list(range(8)), stamps_s) == pytest.approx(1.0, abs=0.05)


def test_frames_that_are_left_out_are_no_odd_stamps() -> None:
    frames = [0, 4, 8, 12, 16, 17, 18]
    assert ahead(frames, [i / RATE_HZ for i in frames]) == pytest.approx(1.0)
    frames = [0, 1, 2, 3, 4, 8]
    assert ahead(frames, [i / RATE_HZ for i in frames]) == pytest.approx(4.0)


def test_an_image_that_comes_again_is_no_halt() -> None:
    """A video of 15 Hz that is stored with 30 Hz moves by two motions between every other frame."""
    tracks = [track(2 * (i // 2), i / RATE_HZ, image(2 * (i // 2))) for i in range(8)]
    motion = Motion()
    for before, after in pairwise(tracks):
        motion = motion.next(before, after)
    T = motion.predict(tracks[-1], 8 / RATE_HZ)
    np.testing.assert_allclose(se3.log(T @ se3.inverse(se3.exp(6 * XI))), 2 * XI, atol=1e-9)


def test_an_image_that_keeps_coming_again_is_a_halt() -> None:
    tracks = [track(min(i, 3), i / RATE_HZ, image(min(i, 3))) for i in range(12)]
    motion = Motion()
    for before, after in pairwise(tracks):
        motion = motion.next(before, after)
    np.testing.assert_allclose(motion.predict(tracks[-1], 12 / RATE_HZ), se3.exp(3 * XI), atol=1e-9)


def test_one_stamp_for_all_is_one_motion_each() -> None:
    assert ahead(list(range(6)), [0.0] * 6) == pytest.approx(1.0)


def test_a_change_of_scale_keeps_what_is_usual() -> None:
    tracks = [track(i, stamp / RATE_HZ) for i, stamp in enumerate([0.0, 1.0, 2.0, 3.99, 4.0])]
    motion = Motion()
    for before, after in pairwise(tracks[:-1]):
        motion = motion.next(before, after).scaled(1.0)
    motion = motion.next(tracks[-2], tracks[-1])
    assert motion.interval_s == pytest.approx(1 / RATE_HZ)
