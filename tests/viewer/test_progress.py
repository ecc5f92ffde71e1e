"""What a run is doing, in one line."""

from __future__ import annotations

import io
from typing import cast

import numpy as np
import pytest

from dualslam.core.types import Frame, FrameStatus
from dualslam.core.walk_news import WalkNews
from dualslam.map.frame_records import FrameResult
from dualslam.system.system import System
from dualslam.viewer import progress
from dualslam.viewer.progress import FINISHING, Progress


class Walking:
    """A system of which only its walks are known."""

    is_walking = True

    def watch_walks(self, on_walk: object) -> None:
        self.tell = on_walk

    def is_tracking_in_reverse(self, submap_id: int) -> bool:
        return self.is_walking


class Screen(io.StringIO):
    """A terminal."""

    def isatty(self) -> bool:
        return True


def step(shown: Progress, i: int, status: FrameStatus = FrameStatus.TRACKED) -> None:
    submap = 0 if status is FrameStatus.TRACKED else None
    shown.after(Frame(i, 0.1 * i, None), FrameResult(i, status, submap, None, 90, 80, 10.0, None))


def news(frame: int) -> WalkNews:
    return WalkNews(1, "live", frame, True, 3, None, np.zeros((4, 3), np.float32))


def watched(stream: io.StringIO, n: int | None) -> tuple[Progress, Walking]:
    shown, system = Progress(n, stream), Walking()
    shown.begin(cast(System, system))
    return shown, system


@pytest.fixture(autouse=True)
def _always_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "IN_PLACE_S", 0.0)
    monkeypatch.setattr(progress, "LINE_S", 0.0)


def test_each_line_says_how_far_and_what() -> None:
    shown, system = watched(stream := io.StringIO(), 4)
    step(shown, 0)
    step(shown, 1, FrameStatus.LOST)
    system.tell(news(17))  # type: ignore[operator]
    step(shown, 2)
    system.is_walking = False
    step(shown, 3)
    shown.end()
    lines = stream.getvalue().splitlines()
    assert lines[0].startswith("1 of 4 frames, 0:00 left: tracked, submap 0, 80 landmarks")
    assert lines[1].endswith("left: lost")
    assert lines[2].endswith("lost; tracking in reverse from submap 1: at frame 17, 3 posed")
    assert "tracked" in lines[3]
    assert "at frame 17" in lines[3]
    assert lines[4] == lines[5] == f"4 of 4 frames: {FINISHING}"


def test_the_end_waits_for_a_walk() -> None:
    shown, system = watched(stream := io.StringIO(), 1)
    step(shown, 0)
    system.tell(news(5))  # type: ignore[operator]
    assert (
        stream.getvalue().splitlines()[-1].endswith("results; tracking in reverse from submap 1: at frame 5, 3 posed")
    )


def test_on_a_terminal_a_line_takes_the_place_of_the_one_before() -> None:
    shown, system = watched(stream := Screen(), None)
    system.tell(news(5))  # type: ignore[operator]
    system.is_walking = False
    step(shown, 0)
    shown.end()
    assert stream.getvalue().count("\n") == 1
    first, second = stream.getvalue().split("\r")[1:3]
    assert first.startswith("frame 0: tracking in reverse")
    assert second.rstrip() == "frame 1: tracked, submap 0, 80 landmarks"
    assert len(second) == len(first), "nothing of a longer one stays"


def test_a_run_that_is_soon_over_says_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "LINE_S", 60.0)
    shown, _ = watched(stream := io.StringIO(), 2)
    step(shown, 0)
    step(shown, 1)
    shown.end()
    assert not stream.getvalue()


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.4, "0:00"), (59.6, "1:00"), (754, "12:34"), (3 * 3600 + 5, "3:00:05")]
)
def test_durations(seconds: float, words: str) -> None:
    assert progress._duration(seconds) == words
