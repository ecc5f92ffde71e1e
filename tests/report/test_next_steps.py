"""What a person reads first: the camera and the commands, which the command line must understand."""

from __future__ import annotations

import html
import re
import shlex
from dataclasses import replace
from pathlib import Path

import pytest

from dualslam.cli.parser import parse
from dualslam.report import RunData
from dualslam.report.trust import camera_words, next_steps


def commands(run: RunData) -> list[str]:
    return [html.unescape(each) for each in re.findall(r'<pre class="command">(.*?)</pre>', next_steps(run))]


@pytest.mark.parametrize("searched", [False, True])
def test_each_command_is_one_that_can_be_typed(broken_run: RunData, searched: bool, tmp_path: Path) -> None:
    summary = broken_run.summary | {"source": "a walk.mp4"} | ({"focal_search": {"fov_deg": 60}} if searched else {})
    given = commands(replace(broken_run, path=tmp_path / "a run", summary=summary))
    assert any("--camera" in command for command in given) == searched
    assert any("dualslam eval" in command for command in given) == bool(len(broken_run.truth))
    for command in given:
        program, *words = shlex.split(command.replace("METRES", "2.5"))
        assert program == "dualslam"
        parse(words)


def test_without_a_map_there_is_one_thing_to_try(broken_run: RunData) -> None:
    nothing = replace(broken_run.main, row=broken_run.main.row[:0], T_map_cam=broken_run.main.T_map_cam[:0])
    (command,) = commands(replace(broken_run, main=nothing))
    assert "--camera FILE" in command


def test_the_camera_says_how_sure_it_is_and_where_it_is_from(broken_run: RunData) -> None:
    camera = {"model": "pinhole", "width": 640, "height": 480, "fx": 585.0}
    summary = broken_run.summary | {"camera": camera, "calibration": "calib.txt", "refined": None}
    words = camera_words(replace(broken_run, summary=summary))
    assert words is not None
    assert "585 px, from calib.txt" in words
    refined = {"focal_px": 580.0, "log_focal_sigma": 0.004}
    searched = summary | {"focal_search": {"focal_range_px": [513.0, 586.2]}, "refined": refined}
    words = camera_words(replace(broken_run, summary=searched))
    assert words is not None
    assert "searched for in the first frames (513 to 586.2 px)" in words
    assert "580 px, sigma 0.4 %" in words
    assert camera_words(replace(broken_run, summary={})) is None
