"""The page of a map: what it draws is what the run folder says, and a browser draws it without a complaint."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dualslam.core.types import FloatArray
from dualslam.report import RunData, report_page
from dualslam.viewer.colours import STATUS_COLOURS, rgb
from dualslam.viewer.map_page import map_page
from dualslam.viewer.playback import play
from tests.report.test_browser import BROWSER, browse


def drawn(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    data: dict[str, Any] = json.loads(found.group(1))
    return data


def unpacked(part: dict[str, str]) -> tuple[FloatArray, FloatArray, FloatArray]:
    xyz, row = (np.frombuffer(base64.b64decode(part[name]), np.float32) for name in ("xyz", "row"))
    return xyz.reshape(-1, 3), np.frombuffer(base64.b64decode(part["rgb"]), np.uint8).reshape(-1, 3), row


@pytest.fixture(scope="module")
def page(broken_run: RunData) -> str:
    page = map_page(broken_run)
    assert page is not None
    return page


def test_cameras_stand_where_their_frames_were_posed(page: str, broken_run: RunData) -> None:
    playback = play(broken_run)
    xyz, colours, row = unpacked(drawn(page)["cameras"])
    main = playback.spaces[0].posed
    assert np.allclose(xyz[: len(main)], main.xyz, atol=1e-4)
    assert row.tolist() == [r for space in playback.spaces for r in space.posed.row.tolist()]
    for r, colour in zip(row.astype(int).tolist(), colours.tolist(), strict=True):
        assert tuple(colour) == rgb(STATUS_COLOURS[playback.rows[r].status])


def test_landmarks_appear_with_the_frame_that_brought_them(page: str, broken_run: RunData) -> None:
    xyz, _, row = unpacked(drawn(page)["landmarks"])
    spaces = play(broken_run).spaces
    assert len(xyz) == sum(len(space.landmarks) for space in spaces)
    assert np.allclose(xyz[: len(spaces[0].landmarks)], spaces[0].landmarks.xyz, atol=1e-3)
    assert row.tolist() == [r for space in spaces for r in space.landmarks.row.tolist()]


def test_a_map_that_is_not_linked_stands_beside(page: str, broken_run: RunData) -> None:
    spaces = play(broken_run).spaces
    assert len(spaces) == 2
    xyz, _, _ = unpacked(drawn(page)["cameras"])
    n = len(spaces[0].posed)
    assert xyz[n:, 0].min() > xyz[:n, 0].max()
    assert np.allclose(np.diff(xyz[n:], axis=0), np.diff(spaces[1].posed.xyz, axis=0), atol=1e-4)


def test_a_run_without_poses_has_no_page(broken_run: RunData) -> None:
    nothing = replace(broken_run.main, row=broken_run.main.row[:0], T_map_cam=broken_run.main.T_map_cam[:0])
    assert map_page(replace(broken_run, main=nothing, unlinked={})) is None


def test_names_cannot_break_the_page(broken_run: RunData) -> None:
    hostile = replace(broken_run, summary=broken_run.summary | {"sequence": "</script><script>alert(1)</script>${x}"})
    page = map_page(hostile)
    assert page is not None
    assert page.count("<script") == 2
    assert "alert(1)&lt;/script&gt;${x}" in page


def test_the_report_leads_there(broken_run: RunData, page: str, tmp_path: Path) -> None:
    assert 'href="map.html"' not in report_page(replace(broken_run, path=tmp_path))
    (tmp_path / "map.html").write_text(page)
    assert 'href="map.html"' in report_page(replace(broken_run, path=tmp_path))


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
@pytest.mark.parametrize("width", [500, 1400])
def test_a_browser_draws_it(page: str, width: int, tmp_path: Path) -> None:
    (tmp_path / "map.html").write_text(page)
    shot = tmp_path / "shot.png"
    done = browse(
        tmp_path / "map.html",
        tmp_path / "profile",
        width,
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        f"--screenshot={shot}",
    )
    complaints = [line for line in done.stderr.splitlines() if "CONSOLE" in line and "GPU stall" not in line]
    assert not complaints
    middle = cv2.imread(str(shot)).astype(int)[150:-150]
    blue, green, red = middle[..., 0], middle[..., 1], middle[..., 2]
    assert ((blue > red + 60) & (blue > green + 30)).sum() > 20, "the way, where it was tracked"
