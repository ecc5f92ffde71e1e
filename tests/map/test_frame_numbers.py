"""Frames count as they come; rows and files tell them by their index in the source."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from dualslam.core.errors import InputError
from dualslam.core.types import Frame
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


def test_frames_within_a_part_of_an_event_are_told_too_and_marks_stay() -> None:
    count = FrameNumbers(1000)
    for i in (20, 19, 18):
        count.number(i)
    solved = {"rejected": [{"submap": 1, "keyframe": 1021, "other_keyframe": -1}], "factors": {"loop": 1020}}
    assert count.in_source(solved) == {
        "rejected": [{"submap": 1, "keyframe": 19, "other_keyframe": -1}],
        "factors": {"loop": 1020},
    }
    cut = {"old_submap": 1, "left": [1020, 1021]}
    assert count.in_source(cut) == {"old_submap": 1, "left": [20, 19]}


GREY = np.zeros((4, 6), np.uint8)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Frame(-1, 0.0, GREY), "a frame's index is -1"),
        (lambda: Frame("7", 0.0, GREY), "a frame's index is '7'"),
        (lambda: Frame(7, float("nan"), GREY), "frame 7: its time is nan"),
        (lambda: Frame(7, None, GREY), "frame 7: its time is None"),
        (lambda: Frame(7, 0.0, GREY.astype(float)), r"frame 7: its image is \(4, 6\) float64; it must be"),
        (lambda: Frame(7, 0.0, GREY[None]), r"its image is \(1, 4, 6\) uint8"),
        (lambda: Frame(7, 0.0, GREY[:0]), r"its image is \(0, 6\) uint8"),
        (lambda: Frame(7, 0.0, GREY.tolist()), "its image is a list"),
    ],
)
def test_what_is_no_frame_is_refused_as_it_is_made(make: Callable[[], Frame], words: str) -> None:
    with pytest.raises(InputError, match=words):
        make()


def test_frames_of_other_libraries_numbers_are_frames() -> None:
    assert FrameNumbers().numbered(Frame(np.int32(7), np.float32(0.5), None)).index == 7
    Frame(7, 1, np.dstack([GREY] * 3)[:, ::-1])


@pytest.mark.parametrize(("given", "then"), [([3], 3), ([3, 4], 3), ([3, 2], 4), ([0, 5], 4)])
def test_each_frame_lies_beyond_the_last(given: list[int], then: int) -> None:
    count = FrameNumbers()
    for i in given:
        count.numbered(Frame(i, 0.0, None))
    with pytest.raises(InputError, match=f"frame {then} comes after frame {given[-1]}"):
        count.numbered(Frame(then, 0.0, None))


def test_nothing_comes_after_the_end() -> None:
    count = FrameNumbers()
    count.numbered(Frame(0, 0.0, None))
    count.end()
    with pytest.raises(InputError, match="frame 1 comes after"):
        count.numbered(Frame(1, 0.1, None))
    with pytest.raises(InputError, match="not a ndarray"):
        count.numbered(GREY)  # type: ignore[arg-type]
