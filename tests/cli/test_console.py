"""What a person sees while a run goes on, and that nobody else sees anything."""

from __future__ import annotations

import io
import sys

import pytest

from dualslam.cli.console import FINISHING, progress
from dualslam.core.types import FrameStatus
from dualslam.map.frame_records import FrameResult
from dualslam.run.sources import open_source

SOURCE = "synthetic:street,frames=3,seed=1,width=160,height=120"


class Screen(io.StringIO):
    """A terminal that somebody watches."""

    def isatty(self) -> bool:
        return True


def tracked(i: int) -> FrameResult:
    return FrameResult(i, FrameStatus.TRACKED, 0, None, 90, 80, 10.0, None)


def test_the_bar_says_what_a_run_does_once_all_frames_are_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setattr(sys, "stderr", screen := Screen())
    sequence = open_source(SOURCE)
    with progress(sequence, quiet=False) as on_frame:
        assert on_frame is not None
        for i in range(len(sequence)):
            assert FINISHING not in screen.getvalue()
            on_frame(tracked(i))
    assert "3/3" in screen.getvalue()
    assert FINISHING in screen.getvalue()


@pytest.mark.parametrize(("watched", "quiet"), [(False, False), (True, True)])
def test_nobody_watches(monkeypatch: pytest.MonkeyPatch, watched: bool, quiet: bool) -> None:
    screen = Screen() if watched else io.StringIO()
    monkeypatch.setattr(sys, "stderr", screen)
    with progress(open_source(SOURCE), quiet) as on_frame:
        assert on_frame is None
    assert not screen.getvalue()
