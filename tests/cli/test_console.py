"""What a person sees while a run goes on, and that nobody else sees anything."""

from __future__ import annotations

import io
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from dualslam.cli.console import final_line, no_map_line, progress, verdict_line, waiting
from dualslam.cli.logs import CLEARED
from dualslam.core.types import Frame, FrameStatus
from dualslam.core.walk_news import WalkNews
from dualslam.map.frame_records import FrameResult
from dualslam.run.sources import open_source
from dualslam.viewer import progress as lines
from dualslam.viewer.progress import FINISHING, Progress

SOURCE = "synthetic:street,frames=3,seed=1,width=160,height=120"


@pytest.fixture(autouse=True)
def _always_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lines, "IN_PLACE_S", 0.0)


class Screen(io.StringIO):
    """A terminal that somebody watches."""

    def isatty(self) -> bool:
        return True


def tracked(i: int) -> FrameResult:
    return FrameResult(i, FrameStatus.TRACKED, 0, None, 90, 80, 10.0, None)


def test_the_line_says_what_a_run_does_once_all_frames_are_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setattr(sys, "stderr", screen := Screen())
    sequence = open_source(SOURCE)
    with progress(sequence, quiet=False) as shown:
        assert shown is not None
        for i in range(len(sequence)):
            assert FINISHING not in screen.getvalue()
            shown.after(Frame(i, 0.1 * i, None), tracked(i))
    assert "3 of 3 frames" in screen.getvalue()
    assert FINISHING in screen.getvalue()


def test_what_nothing_counts_is_told_while_it_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", screen := Screen())
    with waiting("looking for the camera", quiet=False):
        assert screen.getvalue() == "looking for the camera ..."
    assert screen.getvalue().endswith(CLEARED)


@pytest.mark.parametrize(("watched", "quiet"), [(False, False), (True, True)])
def test_nobody_watches(monkeypatch: pytest.MonkeyPatch, watched: bool, quiet: bool) -> None:
    screen = Screen() if watched else io.StringIO()
    monkeypatch.setattr(sys, "stderr", screen)
    with progress(open_source(SOURCE), quiet) as shown:
        assert shown is None
    with waiting("looking for the camera", quiet):
        pass
    assert not screen.getvalue()


def test_frames_that_the_saved_map_does_not_show_are_told(tmp_path: Path) -> None:
    summary = {
        "coverage": 0.0,
        "posed": 0,
        "frames": 300,
        "posed_in_all_submaps": 280,
        "submaps": 2,
        "links": 0,
        "failures": 0,
        "recoveries": 0,
        "dropped": 0,
        "fps": 20.0,
        "interrupted": False,
        "first_id": 500,
    }
    outcome = SimpleNamespace(summary=summary, has_map=False, out=tmp_path)
    line = final_line(outcome)  # type: ignore[arg-type]
    assert line.startswith("not found in the saved map: coverage 0.0 %")
    assert "280 frames posed in submaps that are not joined to the saved map" in line
    outcome.summary["first_id"] = 0
    outcome.summary["no_map"] = "nothing moves"
    line = final_line(outcome)  # type: ignore[arg-type]
    assert line.startswith("no map: ")
    assert line.endswith(f"; nothing moves; results in {tmp_path}")
    assert no_map_line(outcome) == f"no map: nothing moves; results in {tmp_path}"  # type: ignore[arg-type]


def test_what_a_run_found_again_and_linked_is_told(tmp_path: Path) -> None:
    counts = {"submaps": 2, "links": 1, "failures": 1, "recoveries": 0, "relocalised": 1, "loops": 2, "merges": 0}
    rest = {"dropped": 0, "fps": 20.0, "interrupted": False, "first_id": 0}
    summary = {"coverage": 1.0, "posed": 9, "frames": 9, "posed_in_all_submaps": 9} | counts | rest
    outcome = SimpleNamespace(summary=summary, has_map=True, out=tmp_path)
    assert ", 2 submaps (linked), 1 failure, 1 relocalisation, 2 loops, 20.0 frames/s" in final_line(outcome)  # type: ignore[arg-type]
    summary["posed_in_all_submaps"] = 12  # a later map has frames of its own
    assert ", 2 submaps, 1 failure" in final_line(outcome)  # type: ignore[arg-type]


def test_the_verdict_is_one_line(tmp_path: Path) -> None:
    reasons = [{"code": "jump", "text": "It jumps. Look there.", "first_frame": 1, "last_frame": 2}]
    outcome = SimpleNamespace(summary={"verdict": {"level": "doubtful", "reasons": reasons}})
    assert verdict_line(outcome) == "verdict: doubtful. It jumps. Look there."  # type: ignore[arg-type]
    outcome.summary["verdict"] = {"level": "good", "reasons": []}
    assert verdict_line(outcome) == "verdict: good."  # type: ignore[arg-type]


class LongRecording:
    name = "a_recording_with_a_name_of_many_words"

    def __len__(self) -> int:
        return 9000


def test_80_columns_have_room_for_count_and_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(sys, "stderr", screen := Screen())
    with progress(LongRecording(), quiet=False) as shown:  # type: ignore[arg-type]
        assert isinstance(shown, Progress)
        shown._system = SimpleNamespace(is_tracking_in_reverse=lambda _: True)  # type: ignore[assignment]
        shown._walk = WalkNews(12, "live", 8123, True, 456, None, np.zeros((0, 3), np.float32))
        shown.after(Frame(0, 0.0, None), tracked(0))
    shown_lines = screen.getvalue().replace("\r", "\n").splitlines()
    assert any(line.startswith("1 of 9000 frames, ") and "left: tracked, submap 0" in line for line in shown_lines)
    assert max(map(len, shown_lines)) < 80
