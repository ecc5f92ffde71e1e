"""A step that does not fit the speed about it is found; a camera that starts, stops or speeds up is not."""

from __future__ import annotations

import numpy as np

from dualslam.core.types import FloatArray
from dualslam.system.audit.verdict import measure_jumps

TIMES = np.arange(200) / 30
SUSPECT = 0.1


def along_x(x: FloatArray) -> FloatArray:
    return np.column_stack([x, np.zeros((len(x), 2))])


def test_a_jump_stands_out_by_its_length() -> None:
    x = 0.5 * TIMES
    x[120:] += 0.8  # 48 steps
    jumps = measure_jumps(TIMES, along_x(x))
    assert np.flatnonzero(jumps > SUSPECT).tolist() == [119]
    np.testing.assert_allclose(jumps[119], 0.8, err_msg="of 1 m in two seconds")


def test_a_jump_counts_by_the_way_of_two_seconds_at_all_usual_rates() -> None:
    for every in (1, 2, 3):
        x = 0.5 * TIMES
        x[120:] += 0.3
        np.testing.assert_allclose(measure_jumps(TIMES[::every], along_x(x[::every])).max(), 0.3)
    for unit in (1e3, 1e6):
        assert measure_jumps(unit * TIMES, along_x(0.5 * TIMES)).max() < 0.01


def test_a_frame_that_is_off_by_itself_is_found_on_both_sides() -> None:
    x = 0.5 * TIMES
    x[120] += 0.8
    assert np.flatnonzero(measure_jumps(TIMES, along_x(x)) > SUSPECT).tolist() == [119, 120]


def test_a_camera_may_rest_start_and_speed_up() -> None:
    speed = np.concatenate([np.zeros(60), np.linspace(0, 1.0, 20), np.full(60, 1.0), np.full(60, 3.0)])
    jumps = measure_jumps(TIMES, along_x(np.cumsum(speed) / 30))
    assert jumps.max() < SUSPECT


def test_timestamps_that_repeat_are_no_jump() -> None:
    in_pairs = np.repeat(TIMES[::2], 2)
    assert measure_jumps(in_pairs, along_x(0.5 * TIMES)).max() < SUSPECT
    x = 0.5 * TIMES
    x[120:] += 0.8
    assert measure_jumps(in_pairs, along_x(x))[119] > 2 * SUSPECT


def test_missing_frames_are_no_jump() -> None:
    kept = np.r_[0:80, 110:200]
    assert measure_jumps(TIMES[kept], along_x(0.5 * TIMES[kept])).max() < 0.01


def test_a_few_frames_tell_nothing() -> None:
    assert measure_jumps(TIMES[:8], along_x(np.r_[np.zeros(4), np.ones(4)])).tolist() == [0.0] * 7
