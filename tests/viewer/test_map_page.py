"""The page of a map: what it draws is what the run folder says, and a browser draws it without a complaint."""

from __future__ import annotations

import base64
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dualslam.core.types import FloatArray
from dualslam.io.colours import save_colours, save_pictures
from dualslam.io.export.metric import write_scale
from dualslam.io.map_files import load_arrays
from dualslam.io.map_store import load_atlas, submap_path
from dualslam.io.run_folder import MAP
from dualslam.report import RunData, report_page
from dualslam.viewer.colours import STATUS_COLOURS, rgb
from dualslam.viewer.map_page import RED, map_page
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
        assert tuple(colour) == (RED if playback.rows[r].doubt else rgb(STATUS_COLOURS[playback.rows[r].status]))


def test_landmarks_appear_with_the_frame_that_brought_them(page: str, broken_run: RunData) -> None:
    xyz, _, row = unpacked(drawn(page)["landmarks"])
    spaces = play(broken_run).spaces
    assert len(xyz) == sum(len(space.landmarks) for space in spaces)
    assert np.allclose(xyz[: len(spaces[0].landmarks)], spaces[0].landmarks.xyz, atol=1e-3)
    assert row.tolist() == [r for space in spaces for r in space.landmarks.row.tolist()]


def test_landmarks_have_the_colours_of_the_images(broken_run: RunData, tmp_path: Path) -> None:
    shutil.copytree(broken_run.path / MAP, tmp_path / MAP)
    _, of_submaps, _ = unpacked(drawn(map_page(broken_run) or "")["landmarks"])
    ids = load_atlas(tmp_path / MAP).atlas.submaps
    n = {m: len(load_arrays(submap_path(tmp_path / MAP, m), ["landmarks_alive"])["landmarks_alive"]) for m in ids}
    save_colours(tmp_path / MAP, {m: np.tile(np.array([200, 100, 50 + m], np.uint8), (n[m], 1)) for m in ids})
    _, colours, _ = unpacked(drawn(map_page(replace(broken_run, path=tmp_path)) or "")["landmarks"])
    assert len(colours) == len(of_submaps)
    assert set(map(tuple, colours.tolist())) <= {(200, 100, 50 + m) for m in ids}


def test_doubtful_and_missing_stretches_are_red(broken_run: RunData) -> None:
    doubted = [replace(row, doubt="scale" if 10 <= row.index <= 14 else "") for row in broken_run.rows]
    page = map_page(replace(broken_run, rows=doubted)) or ""
    playback = play(replace(broken_run, rows=doubted))
    _, colours, row = unpacked(drawn(page)["cameras"])
    red = {int(r) for r, colour in zip(row, colours.tolist(), strict=True) if tuple(colour) == RED}
    assert red == {int(r) for r in row if playback.rows[int(r)].doubt}
    _, colours, row = unpacked(drawn(page)["way"])
    bridges = set(row[(colours == RED).all(axis=1)].astype(int).tolist())
    assert {r for space in playback.spaces for r in space.posed.row[1:][np.diff(space.posed.row) > 1]} <= bridges
    assert len(re.findall(r'<i style="left:[^"]*background:rgb\(232, 80, 91\)', page)) > 1


def test_the_camera_at_the_slider_stands_where_its_frame_was_posed(page: str, broken_run: RunData) -> None:
    poses = drawn(page)["poses"]
    row, T = (np.frombuffer(base64.b64decode(poses[name]), np.float32) for name in ("row", "T"))
    main = play(broken_run).spaces[0].posed
    of_main = {int(r): t for r, t in zip(row, T.reshape(-1, 3, 4), strict=True) if r in main.row}
    assert of_main
    for r, t in of_main.items():
        assert np.allclose(t, main.T_map_cam[main.row == r][0, :3], atol=1e-4)


def test_the_picture_at_the_slider_is_one_that_the_run_kept(broken_run: RunData, tmp_path: Path) -> None:
    shutil.copytree(broken_run.path / MAP, tmp_path / MAP)
    save_pictures(tmp_path / MAP, {3: b"jpeg", 40: b"other"})
    kept = drawn(map_page(replace(broken_run, path=tmp_path)) or "")["pictures"]
    assert {int(i): base64.b64decode(jpeg) for i, jpeg in kept.items()} == {3: b"jpeg", 40: b"other"}


def test_the_grid_is_in_metres_where_these_are_known(page: str, broken_run: RunData, tmp_path: Path) -> None:
    shutil.copytree(broken_run.path / MAP, tmp_path / MAP)
    write_scale(tmp_path, 2.0, None, "a ruler")
    (units,) = re.findall(r"grid: ([\d.]+) units of the map", page)
    (metres,) = re.findall(r"grid: ([\d.]+) m<", map_page(replace(broken_run, path=tmp_path)) or "")
    assert float(metres) == pytest.approx(2 * float(units))


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
@pytest.mark.parametrize("width", [500, pytest.param(1400, marks=pytest.mark.slow)])
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
