"""Frames count as they come; rows and files tell them by their index in the source."""

from __future__ import annotations

import pytest

from dualslam.map.frame_numbers import FrameNumbers


@pytest.mark.parametrize(
    ("first_id", "indices", "numbers"),
    [
        (0, [0, 1, 2, 5], [0, 1, 2, 5]),
        (0, [200, 202, 204], [200, 202, 204]),
        (0, [69, 68, 66, 0], [69, 70, 72, 138]),
        (1000, [20, 21, 24], [1020, 1021, 1024]),
        (1000, [20, 19, 16], [1020, 1021, 1024]),
    ],
)
def test_numbers_ascend_and_lead_back(first_id: int, indices: list[int], numbers: list[int]) -> None:
    count = FrameNumbers(first_id)
    assert [count.number(i) for i in indices] == numbers
    assert [count.index_of(n) for n in numbers] == indices
    again = FrameNumbers(first_id, count.first_index)  # as a run folder tells it
    assert [again.number_of(i) for i in indices] == numbers


def test_events_name_frames_by_their_index() -> None:
    count = FrameNumbers()
    for i in (9, 8, 7, 6):
        count.number(i)
    told = count.in_source(
        {"lost_since": 10, "change_point": 11.0, "agreeing_keyframes": [9, 12], "torn": None, "inliers": 12}
    )
    assert told == {"lost_since": 8, "change_point": 7.0, "agreeing_keyframes": [9, 6], "torn": None, "inliers": 12}
    assert isinstance(told["change_point"], float)
