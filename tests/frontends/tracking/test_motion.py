"""Where the motion of the last frames leads, whatever the stamps of the frames are."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from dualslam.core.geometry import se3
from dualslam.core.types import Track, View
from dualslam.frontends.tracking.motion import Motion
from dualslam.testing.point_world import make_features

RATE_HZ = 30.0
XI = np.array([0.0, 0.02, 0.0, 0.01, 0.0, 0.0])
"""Of a camera, from each frame to the next."""
NO_FEATURES = make_features(np.empty((0, 2)), np.empty(0), np.empty(0, np.int64), np.empty((0, 32), np.uint8))


def track(i: int, stamp_s: float) -> Track:
    T = se3.exp(i * XI)
    none = np.zeros(0, np.int64)
    return Track(View(i, stamp_s, NO_FEATURES), T, T, none, none, 0, 0, 1.0, False, np.zeros((6, 6)))


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


def test_one_stamp_for_all_is_one_motion_each() -> None:
    assert ahead(list(range(6)), [0.0] * 6) == pytest.approx(1.0)


def test_a_change_of_scale_keeps_what_is_usual() -> None:
    tracks = [track(i, stamp / RATE_HZ) for i, stamp in enumerate([0.0, 1.0, 2.0, 3.99, 4.0])]
    motion = Motion()
    for before, after in pairwise(tracks[:-1]):
        motion = motion.next(before, after).scaled(1.0)
    motion = motion.next(tracks[-2], tracks[-1])
    assert motion.interval_s == pytest.approx(1 / RATE_HZ)
