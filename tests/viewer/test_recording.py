"""The viewer's recording, read back: what was written is what the run folder says."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from dualslam.atlas.atlas import Atlas, Link, LinkKind
from dualslam.cli import main
from dualslam.cli.view_command import open_viewer
from dualslam.core.errors import OutputError, how_to_install
from dualslam.core.geometry import sim3, so3
from dualslam.core.types import FrameStatus, Keyframe
from dualslam.io.map_store import load_atlas, save_atlas
from dualslam.io.trajectory_files import read_tum
from dualslam.map.submap import Submap
from dualslam.report import RunData, read_run
from dualslam.report.run_data import PosedRows
from dualslam.viewer.colours import ELSEWHERE, STATUS_COLOURS, SUBMAP_COLOURS
from dualslam.viewer.playback import play, segments
from dualslam.viewer.recording import make_recording
from tests.cli.fakes import NO_FEATURES
from tests.cli.test_usage import one_sentence
from tests.report.conftest import LOST, N_FRAMES, MakeRun

TOL_SINGLE = 1e-5
"""The viewer's numbers are single precision; the scene is a few units wide."""


class Played:
    """A recording by entity: static components, and rows of the others with their times."""

    def __init__(self, file: Path) -> None:
        reader = RrdReader(file)
        assert len(reader.recordings()) == len(reader.blueprints()) == 1
        self.static: dict[str, dict[str, Any]] = {}
        self.rows: dict[str, list[dict[str, Any]]] = {}
        for chunk in reader.stream():
            batch = chunk.to_record_batch()
            names = [name for name in batch.schema.names if not name.startswith("rerun.controls")]
            rows = [{name: row[name] for name in names} for row in batch.to_pylist()]
            path = chunk.entity_path.removeprefix("/")
            if chunk.is_static:
                self.static.setdefault(path, {}).update(rows[0])
            else:
                self.rows.setdefault(path, []).extend(rows)
        for rows in self.rows.values():
            rows.sort(key=lambda row: row["frame"])

    def values(self, path: str, component: str) -> dict[int, Any]:
        """Component of an entity by frame, where it was sent."""
        return {row["frame"]: row[component] for row in self.rows[path] if component in row}

    def times_s(self, path: str, component: str) -> dict[int, float]:
        return {row["frame"]: row["timestamp_s"].total_seconds() for row in self.rows[path] if component in row}


def played(run: RunData, folder: Path) -> Played:
    file = folder / "run.rrd"
    file.write_bytes(make_recording(run))
    return Played(file)


@pytest.fixture(scope="module")
def broken(broken_run: RunData, tmp_path_factory: pytest.TempPathFactory) -> Played:
    return played(broken_run, tmp_path_factory.mktemp("played"))


@pytest.mark.parametrize(("space", "file"), [("map", "trajectory.txt"), ("apart/01", "submaps/01.txt")])
def test_every_posed_frame_has_its_pose_at_its_time(broken: Played, broken_run: RunData, space: str, file: str) -> None:
    trajectory = read_tum(broken_run.path / file)
    assert len(trajectory) in (20, 14)
    index_at = {row.timestamp_s: row.index for row in broken_run.rows}
    moved = broken.values(f"{space}/camera", "Transform3D:translation")
    turned = broken.values(f"{space}/camera", "Transform3D:mat3x3")
    times_s = broken.times_s(f"{space}/camera", "Transform3D:translation")
    assert len(moved) == len(turned) == len(trajectory)
    for timestamp_s, T_map_cam in zip(trajectory.timestamps_s.tolist(), trajectory.T_world_cam, strict=True):
        frame = index_at[timestamp_s]
        assert times_s[frame] == pytest.approx(timestamp_s, abs=1e-6)
        assert np.allclose(moved[frame], T_map_cam[:3, 3], atol=TOL_SINGLE)
        as_rerun_stores_it = rr.components.TransformMat3x3(T_map_cam[:3, :3]).flat_columns
        assert np.allclose(turned[frame][0], as_rerun_stores_it, atol=TOL_SINGLE)


def test_the_lens_is_the_runs(broken: Played, broken_run: RunData) -> None:
    lens, camera = broken.static["map/camera"], play(broken_run).camera
    assert np.allclose(np.reshape(lens["Pinhole:image_from_camera"][0], (3, 3)).T, camera.K)
    assert lens["Pinhole:resolution"] == [[camera.width, camera.height]]


def test_a_camera_without_a_pose_shows_why(broken: Played) -> None:
    def colours(space: str) -> list[int]:
        return [colour for (colour,) in broken.values(f"{space}/camera", "Pinhole:color").values()]

    tracked, lost = STATUS_COLOURS[FrameStatus.TRACKED], STATUS_COLOURS[FrameStatus.LOST]
    n_after = N_FRAMES - LOST[-1] - 1
    assert colours("map") == [tracked] * LOST[0] + [lost] * len(LOST) + [ELSEWHERE] * n_after
    assert colours("apart/01") == [tracked] * n_after  # it is not there before it has a pose


def test_the_way_has_no_piece_over_a_gap(broken_run: RunData, broken: Played) -> None:
    assert list(broken.values("map/path", "LineStrips3D:strips")) == list(range(1, LOST[0]))
    holed = PosedRows(np.array([0, 1, 3, 4]), broken_run.main.T_map_cam[[0, 1, 3, 4]])
    ends, pieces = segments(holed)
    assert ends.tolist() == [1, 4]
    assert np.array_equal(pieces, holed.xyz[[[0, 1], [2, 3]]])


def test_statuses_and_numbers_are_those_of_the_frames(broken: Played, broken_run: RunData) -> None:
    changes = broken.values("status", "StateChange:state")
    assert list(changes) == [0, LOST[0], LOST[-1] + 1]
    for row in broken_run.rows:
        assert changes[max(frame for frame in changes if frame <= row.index)] == [str(row.status)]
    for path, name in (("matches/n_matches", "n_matches"), ("matches/n_inliers", "n_inliers"), ("latency_ms",) * 2):
        sent = broken.values(path, "Scalars:scalars")
        assert sent == {row.index: [getattr(row, name)] for row in broken_run.rows}
    assert len(broken.static["status"]["StateConfiguration:values"]) == len(FrameStatus)


def test_events_are_told_with_their_numbers(broken: Played, broken_run: RunData) -> None:
    rows = broken.rows["events"]
    assert len(rows) == len(broken_run.events) > 5
    assert sorted(row["frame"] for row in rows) == sorted(event["frame"] for event in broken_run.events)
    told = {row["TextLog:text"][0].split(" (")[0]: row for row in rows}
    assert told["failed"]["TextLog:level"] == ["ERROR"]
    assert told["failed"]["frame"] == LOST[0]
    assert "reason no_texture" in told["failed"]["TextLog:text"][0]
    (refused,) = told["link refused"]["TextLog:text"]
    assert told["link refused"]["TextLog:level"] == ["WARN"]
    assert "verdict 9 inliers, 20 needed" in refused
    assert "scale 0.72" in refused
    assert told["reinitialised"]["TextLog:level"] == ["INFO"]


@pytest.fixture(scope="module")
def linked_run(make_run: MakeRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run without a loss whose map has two linked submaps, with 7 landmarks at keyframe 3 and 5 at keyframe 30."""
    folder = tmp_path_factory.mktemp("linked") / "run"
    shutil.copytree(make_run(lost=()), folder)
    atlas, rng = Atlas(), np.random.default_rng(5)
    for m, frame, n in ((0, 3, 7), (1, 30, 5)):
        submap = Submap(m, np.eye(3), np.zeros(32, np.uint8))
        submap.add_keyframe(Keyframe(frame, frame / 10, NO_FEATURES), np.eye(4))
        xyz = rng.uniform(1, 2, (n + 2, 3))
        submap.add_landmarks(xyz, np.zeros((n + 2, 32), np.uint8), np.ones(n + 2), frame)
        submap.landmarks["alive"][0] = False  # culled
        submap.landmarks["distance_mu"][1] = 50.0  # too far to be drawn
        atlas.add(submap)
    S_0_1 = sim3.from_parts(2.0, so3.exp(np.array([0.1, 0.2, 0.3])), np.array([3.0, 0.0, 1.0]))
    atlas.link(Link(0, 1, S_0_1, np.eye(7), LinkKind.RECOVERY))
    save_atlas(folder / "map", atlas, {})
    return folder


def test_landmarks_and_keyframes_appear_when_they_were_seen(linked_run: Path, tmp_path: Path) -> None:
    recording, atlas = played(read_run(linked_run), tmp_path), load_atlas(linked_run).atlas
    S_world_submap = atlas.S_world_submap([0, 1])
    positions = recording.values("map/landmarks", "Points3D:positions")
    colours = recording.values("map/landmarks", "Points3D:colors")
    assert {frame: len(xyz) for frame, xyz in positions.items()} == {3: 7, 30: 5}
    centres = recording.values("map/keyframes", "Points3D:positions")
    for frame, m in ((3, 0), (30, 1)):
        xyz = sim3.act(S_world_submap[m], atlas.submaps[m].landmarks["xyz_mu"][2:])
        assert np.allclose(positions[frame], xyz, atol=TOL_SINGLE)
        assert colours[frame] == [SUBMAP_COLOURS[m]] * len(xyz)
        assert np.allclose(centres[frame], [S_world_submap[m][:3, 3]], atol=TOL_SINGLE)


def test_the_truth_comes_into_the_maps_own_unit(broken_run: RunData, broken: Played, tmp_path: Path) -> None:
    assert len(broken.static["map/truth"]["LineStrips3D:strips"][0]) == N_FRAMES
    S = sim3.from_parts(0.2, so3.exp(np.array([0.3, -0.2, 0.5])), np.array([4.0, 5.0, 6.0]))
    main = PosedRows(broken_run.main.row, sim3.act_on_pose(S, broken_run.main.T_map_cam))
    truth = played(replace(broken_run, main=main), tmp_path).static["map/truth"]["LineStrips3D:strips"][0]
    assert np.allclose(truth, sim3.act(S, broken_run.truth.xyz), atol=TOL_SINGLE)


def test_without_truth_map_or_poses_there_is_still_a_recording(make_run: MakeRun, tmp_path: Path) -> None:
    folder = tmp_path / "bare"
    shutil.copytree(make_run(truth=False, lost=tuple(range(N_FRAMES))), folder)
    shutil.rmtree(folder / "map")
    recording = played(read_run(folder), tmp_path)
    assert not [path for path in recording.rows if path.startswith("map")]
    assert list(recording.values("status", "StateChange:state").values()) == [["lost"]]


def test_frames_that_were_read_backwards_are_played_forwards(
    broken_run: RunData, broken: Played, tmp_path: Path
) -> None:
    last = len(broken_run.rows) - 1

    def turned(posed: PosedRows) -> PosedRows:
        return PosedRows(last - posed.row[::-1], posed.T_map_cam[::-1])

    backwards = replace(
        broken_run,
        rows=broken_run.rows[::-1],
        main=turned(broken_run.main),
        unlinked={m: turned(posed) for m, posed in broken_run.unlinked.items()},
        truth=turned(broken_run.truth),
    )
    recording = played(backwards, tmp_path)
    assert recording.rows == broken.rows
    assert recording.static == broken.static


def test_times_since_1970_are_dates(broken_run: RunData, tmp_path: Path) -> None:
    rows = [replace(row, timestamp_s=1305031102.25 + row.timestamp_s) for row in broken_run.rows]
    recording = played(replace(broken_run, rows=rows, events=[]), tmp_path)
    first = recording.rows["map/camera"][0]["timestamp_s"]
    assert first.isoformat().startswith("2011-05-10T12:38:22.25")


# --- the command


@pytest.fixture(autouse=True)
def _no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.parametrize(("word", "options"), [("view", ["--save"]), ("export", ["--to", "rerun", "--out"])])
def test_the_command_writes_a_recording(
    broken_run: RunData,
    broken: Played,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    word: str,
    options: list[str],
) -> None:
    file = tmp_path / "new" / "run.rrd"
    command = [word, str(broken_run.path), *options, str(file)]
    assert main(command) == 0
    assert str(file) in capsys.readouterr().out
    assert Played(file).rows == broken.rows
    written = file.read_bytes()
    assert main(command) == 2
    assert "--overwrite" in one_sentence(capsys)
    assert file.read_bytes() == written
    assert main([*command, "--overwrite", "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    assert Played(file).rows == broken.rows


def test_without_a_display_it_says_what_to_do(broken_run: RunData, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(broken_run.path)]) == 2
    assert "--save" in one_sentence(capsys)


def test_without_rerun_it_says_how_to_get_it(
    broken_run: RunData, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.delitem(sys.modules, "dualslam.viewer.recording")
    assert main(["view", str(broken_run.path), "--save", str(tmp_path / "run.rrd")]) == 2
    assert how_to_install("view") in one_sentence(capsys)
    assert list(tmp_path.iterdir()) == []


def test_rerun_switched_off_writes_no_empty_file(
    broken_run: RunData, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RERUN", "off")
    assert main(["view", str(broken_run.path), "--save", str(tmp_path / "run.rrd")]) == 2
    assert "switched off" in one_sentence(capsys)
    assert list(tmp_path.iterdir()) == []


def damage_map(folder: Path) -> None:
    (folder / "map" / "submap_00.npz").write_bytes(b"no archive")


def cut_off_frames(folder: Path) -> None:
    lines = (folder / "frames.csv").read_text().splitlines()
    (folder / "frames.csv").write_text("\n".join([lines[0], *lines[2:]]) + "\n")


def map_of_another_run(folder: Path) -> None:
    frames = (folder / "frames.csv").read_text()
    (folder / "frames.csv").write_text(frames.replace("\n0,", "\n999,"))


def forget_camera(folder: Path) -> None:
    summary = json.loads((folder / "summary.json").read_text())
    del summary["camera"]
    (folder / "summary.json").write_text(json.dumps(summary))


def damage_event(folder: Path) -> None:
    (folder / "events.jsonl").write_text('{"event": "failed"}\n')


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (cut_off_frames, "trajectory.txt has a pose at 0.000000 s, where frames.csv has no frame"),
        (damage_map, "submap_00.npz is no map file"),
        (map_of_another_run, "is not the map of this run: its keyframe 0"),
        (forget_camera, "does not name the camera"),
        (damage_event, "an event has no frame or no time"),
        (shutil.rmtree, "is not the folder of a finished run"),
    ],
)
def test_a_damaged_run_is_one_sentence(
    damage: Any, words: str, broken_run: RunData, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, file = tmp_path / "run", tmp_path / "run.rrd"
    shutil.copytree(broken_run.path, folder)
    damage(folder)
    assert main(["view", str(folder), "--save", str(file)]) == 2
    assert words in one_sentence(capsys)
    assert not file.exists()


def test_a_file_that_cannot_be_written_is_one_sentence(
    broken_run: RunData, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert main(["view", str(broken_run.path), "--save", str(tmp_path / "file" / "run.rrd")]) == 2
    assert "cannot be written" in one_sentence(capsys)


def test_saving_leaves_no_settings_behind(broken_run: RunData, tmp_path: Path) -> None:
    home, file = tmp_path / "home", tmp_path / "run.rrd"
    home.mkdir()
    command = [sys.executable, "-m", "dualslam.cli", "view", str(broken_run.path), "--save", str(file)]
    kept = {name: value for name, value in os.environ.items() if not name.startswith("XDG_")}
    subprocess.run(command, env=kept | {"HOME": str(home)}, check=True, capture_output=True)
    assert file.stat().st_size > 0
    assert list(home.rglob("*")) == []


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[tuple[list[str], dict[str, str]]]]:
    """Programs that would have been started, with their environments; the first one that opens a file fails."""
    calls: list[tuple[list[str], dict[str, str]]] = []

    def run(command: list[str], env: dict[str, str], **options: object) -> subprocess.CompletedProcess[str]:
        calls.append((command, env))
        opened = command[-1].endswith(".rrd")
        if opened:
            assert Path(command[-1]).read_bytes() == b"recording"
        words = "INFO starting\nError: no graphics\n" if opened else ""
        return subprocess.CompletedProcess(command, int(opened), "", words)

    monkeypatch.setattr("dualslam.cli.view_command.subprocess.run", run)
    return calls


def test_the_viewer_is_told_to_call_nobody_and_its_complaint_is_passed_on(
    started: list[tuple[list[str], dict[str, str]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("https_proxy", "http://proxy.example")
    monkeypatch.setenv("XDG_CONFIG_HOME", "/mine")
    with pytest.raises(OutputError, match=r"did not open \(Error: no graphics\); write the recording with --save"):
        open_viewer(b"recording")
    (settings, env), (window, env_of_window) = started
    assert settings[-2:] == ["analytics", "disable"]
    assert window[window.index("--bind") + 1] == "127.0.0.1"
    assert env == env_of_window
    assert env["XDG_CONFIG_HOME"] == str(Path(window[-1]).parent)
    assert env["https_proxy"] == env["HTTPS_PROXY"] == env["ALL_PROXY"] == "http://127.0.0.1:9"
    assert not Path(window[-1]).parent.exists()


def test_settings_that_forbid_usage_data_are_written_where_the_viewer_looks(tmp_path: Path) -> None:
    env = os.environ | {"XDG_CONFIG_HOME": str(tmp_path), "XDG_DATA_HOME": str(tmp_path)}
    subprocess.run([sys.executable, "-m", "rerun", "analytics", "disable"], env=env, check=True, capture_output=True)
    assert json.loads((tmp_path / "rerun" / "analytics.json").read_text())["analytics_enabled"] is False
