"""The folder that a run leaves behind."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dualslam.core.errors import InputError, OutputError
from dualslam.core.events import EventKind, EventLog
from dualslam.core.types import FrameMethod, FrameStatus
from dualslam.io import FrameRow, RunFolder, RunRecord, Trajectory, read_kitti, read_tum
from dualslam.io.run_folder import check_vacant, unlinked_submaps
from dualslam.io.run_reading import read_events, read_frames

ROWS = [
    FrameRow(0, 0.1, FrameStatus.INITIALISING, None, False, 0, 0, 12.3456),
    FrameRow(
        2, 0.30000000000000004, FrameStatus.TRACKED, 0, True, 200, 150, 20.0, 0.0125, 0.03, FrameMethod.WIDE, "jump"
    ),
    FrameRow(4, 0.5, FrameStatus.UNREADABLE, None, False, 0, 0, 1.0),
]


def posed(index: list[int]) -> Trajectory:
    T = np.tile(np.eye(4), (len(index), 1, 1))
    T[:, 0, 3] = index
    return Trajectory(np.array(index) * 0.1, T, np.array(index, np.int64))


def record(**changes: object) -> RunRecord:
    content = {
        "frames": ROWS,
        "main": posed([2]),
        "unlinked": {3: posed([7, 6, 5])},
        "summary": {"frames": 3, "fps": np.float64(12.5), "ate_rmse_m": float("nan"), "recovery_s": np.array([1.5])},
    }
    return RunRecord(**{**content, **changes})  # type: ignore[arg-type]


def test_everything_is_written_and_reads_back(tmp_path: Path) -> None:
    log = EventLog()
    with RunFolder(tmp_path / "a" / "run") as run:
        run.write_config({"seed": 3, "frontend": {"name": "orb"}})
        event = log.add(EventKind.FAILED, 7, 0.7, 0, reason="jump", inliers=np.int64(3), ratio=float("inf"))
        run.append_event(event)
        on_disk = (run.path / "events.jsonl").read_text()
        run.write(record())
    assert json.loads(on_disk) == {
        "event": "failed",
        "frame": 7,
        "timestamp_s": 0.7,
        "submap": 0,
        "reason": "jump",
        "inliers": 3,
        "ratio": None,
    }, "on the disk while the run goes on"
    assert (run.path / "frames.csv").read_text().splitlines()[:3] == [
        "index,timestamp_s,status,submap,in_main_map,n_matches,n_inliers,latency_ms,sigma_position_rel,sigma_scale,"
        "method,doubt",
        "0,0.1,initialising,,0,0,0,12.346,,,,",
        "2,0.30000000000000004,tracked,0,1,200,150,20.000,0.0125,0.03,wide,jump",
    ]
    back = read_frames(run.path / "frames.csv")
    assert back[1:] == ROWS[1:]
    assert read_tum(run.path / "trajectory.txt").T_world_cam[:, 0, 3].tolist() == [2]
    assert read_kitti(run.path / "trajectory_kitti.txt").shape == (1, 4, 4)
    assert (run.path / "trajectory_kitti_frames.txt").read_text() == "2\n"
    submaps = unlinked_submaps(run.path)
    assert submaps == {3: run.path / "submaps" / "03.txt"}
    assert read_tum(submaps[3]).T_world_cam[:, 0, 3].tolist() == [5, 6, 7], "ascending in time"
    summary = json.loads((run.path / "summary.json").read_text())
    assert summary == {"frames": 3, "fps": 12.5, "ate_rmse_m": None, "recovery_s": [1.5]}
    assert "seed: 3" in (run.path / "config.yaml").read_text()
    assert read_events(run.path / "events.jsonl")[0]["event"] == "failed"
    assert not [p for p in run.path.rglob("*") if p.name.endswith(".part")]


def test_a_later_word_holds(tmp_path: Path) -> None:
    with RunFolder(tmp_path / "run") as run:
        run.write(record())
        run.write(record(main=posed([2, 5, 6, 7]), unlinked={}))
    assert len(read_tum(run.path / "trajectory.txt")) == 4
    assert unlinked_submaps(run.path) == {}, "submap 3 was linked since"


def test_a_run_that_posed_nothing(tmp_path: Path) -> None:
    with RunFolder(tmp_path / "run") as run:
        run.write(record(main=posed([]), unlinked={}))
    assert (run.path / "trajectory.txt").read_text() == ""
    assert len(read_frames(run.path / "frames.csv")) == 3


def test_what_a_run_that_was_cut_off_has_left(tmp_path: Path) -> None:
    with RunFolder(tmp_path / "run") as run:
        run.write_config({"seed": 3})
        run.append_schedule({"schedule": 1})
        run.write(record())
        run.write_truth(posed([2]))
        (run.path / "map").mkdir()
        (run.path / "map" / "landmarks.npz").write_bytes(b"a map without its last file")
        words = run.what_is_there()
        run.write_map_page("<html>")
        later = run.what_is_there()
    there = (
        "config.yaml, events.jsonl, schedule.jsonl, frames.csv, trajectory.txt, submaps/, summary.json, groundtruth.txt"
    )
    assert words == f"In {run.path} are {there}; not written: map/, report.html."
    assert f"{there}, map.html;" in later


def test_nothing_is_overwritten_without_being_told(tmp_path: Path) -> None:
    path = tmp_path / "run"
    path.mkdir()
    (path / "console.log").write_text("mine")
    with RunFolder(path) as run:
        run.write(record())
        (path / "map").mkdir()
        (path / "map" / "submap_0.npz").write_bytes(b"old")
        (path / "map" / "mine.doc").write_bytes(b"mine")
    before = {p: p.read_bytes() for p in path.rglob("*") if p.is_file()}
    with pytest.raises(OutputError, match=r"run holds trajectory.txt already.*--overwrite"):
        RunFolder(path)
    assert before == {p: p.read_bytes() for p in path.rglob("*") if p.is_file()}
    with RunFolder(path, overwrite=True):
        pass
    left = sorted(str(p.relative_to(path)) for p in path.rglob("*") if p.is_file())
    assert left == ["console.log", "events.jsonl", "map/mine.doc"], "only what runs write was removed"


def test_files_that_no_run_has_written_are_never_overwritten(tmp_path: Path) -> None:
    """A TUM RGB-D sequence holds a ``groundtruth.txt``: a run that is sent there must not take it for its own."""
    (tmp_path / "groundtruth.txt").write_text("precious")
    with pytest.raises(OutputError, match=r"holds groundtruth.txt already, and that is no run's"):
        RunFolder(tmp_path, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["groundtruth.txt"]


def test_one_run_at_a_time_writes_to_a_folder(tmp_path: Path) -> None:
    with RunFolder(tmp_path / "run") as first:
        first.write_config("mine: 1\n")
        with pytest.raises(OutputError, match="run is being written to by another run"):
            RunFolder(tmp_path / "run", overwrite=True)
        assert (first.path / "config.yaml").read_text() == "mine: 1\n"
    RunFolder(tmp_path / "run", overwrite=True).close()


def test_asking_changes_nothing(tmp_path: Path) -> None:
    check_vacant(tmp_path / "run", overwrite=False)
    assert list(tmp_path.iterdir()) == []
    RunFolder(tmp_path / "run").close()
    check_vacant(tmp_path / "run", overwrite=True)
    with pytest.raises(OutputError, match="--overwrite"):
        check_vacant(tmp_path / "run", overwrite=False)


def test_places_that_cannot_be_used(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file cannot be written to"):
        RunFolder(tmp_path / "file")
    with pytest.raises(OutputError, match="cannot be written to"):
        RunFolder(tmp_path / "file" / "run")


def test_a_folder_that_cannot_be_cleared_is_let_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run"
    with RunFolder(path) as run:
        run.write_config("mine: 1\n")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
        with pytest.raises(OutputError, match="No space left"):
            RunFolder(path, overwrite=True)
    RunFolder(path, overwrite=True).close()


class _Full(io.FileIO):
    """The events of a run, on a disk that is full for a while."""

    def __init__(self, run: RunFolder) -> None:
        super().__init__(run.path / "events.jsonl", "w")
        self.full = True
        run._lines["events.jsonl"].close()
        run._lines["events.jsonl"] = io.TextIOWrapper(io.BufferedWriter(self), encoding="utf-8")

    def write(self, data: Any, /) -> int:
        if self.full:
            raise OSError(28, "No space left on device")
        return super().write(data)


def test_an_event_that_a_full_disk_refuses_is_written_once_when_it_has_room(tmp_path: Path) -> None:
    with RunFolder(tmp_path / "run") as run:
        file, events = _Full(run), EventLog()
        with pytest.raises(OutputError, match="No space left"):
            run.append_event(events.add(EventKind.FUSED, 1, 0.1, 0))
        assert run.n_events == 1
        file.full = False
        run.append_event(events.add(EventKind.FUSED, 2, 0.2, 0))
    assert [event["frame"] for event in read_events(run.path / "events.jsonl")] == [1, 2]


def test_a_disk_that_stays_full_is_told_and_lets_the_folder_go(tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "run")
    _Full(run)
    for fill in (lambda: run.append_event(EventLog().add(EventKind.FUSED, 1, 0.1, 0)), run.close):
        with pytest.raises(OutputError, match="No space left"):
            fill()
    run.close()
    RunFolder(tmp_path / "run", overwrite=True).close()


def test_no_event_after_the_end(tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "run")
    run.close()
    run.close()
    with pytest.raises(OutputError, match="is closed"):
        run.append_event(EventLog().add(EventKind.FUSED, 1, 0.1, 0))


def test_events_cut_off_by_a_crash(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    path.write_text('{"event": "failed"}\n{"event": "arch')
    assert read_events(path) == [{"event": "failed"}]
    path.write_text('{"event": "fai\n{"event": "archived"}\n')
    with pytest.raises(InputError, match="line 1"):
        read_events(path)


@pytest.mark.parametrize(
    ("detail", "words"),
    [
        ('"lost_since": "x"', "lost_since is not a whole number"),
        ('"sigma_scale": [1]', "sigma_scale is not a number"),
        ('"old_submaps": 3', "old_submaps is not a list"),
        ('"factors": 3', "factors is not a mapping"),
    ],
)
def test_what_pages_are_made_of_is_checked_as_it_is_read(tmp_path: Path, detail: str, words: str) -> None:
    path = tmp_path / "events.jsonl"
    path.write_text(f'{{"event": "failed", "frame": 3}}\n{{"event": "failed", "frame": 4, {detail}}}\n')
    with pytest.raises(InputError, match=f"line 2: {words}"):
        read_events(path)


def test_a_standard_deviation_below_zero_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    header = "index,timestamp_s,status,submap,in_main_map,n_matches,n_inliers,latency_ms,sigma_position_rel,sigma_scale"
    path.write_text(f"{header}\n1,0.1,tracked,0,1,9,9,1,0.1,-1\n")
    with pytest.raises(InputError, match=r"line 2: .*-1 is no standard deviation"):
        read_frames(path)


def test_bad_frames_csv(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="columns should be index,timestamp_s"):
        read_frames(path)
    path.write_text(
        "index,timestamp_s,status,submap,in_main_map,n_matches,n_inliers,latency_ms\n1,0.1,sleeping,,0,0,0,1\n"
    )
    with pytest.raises(InputError, match="line 2"):
        read_frames(path)


def test_frames_csv_of_before_sigmas_were_written(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    columns = "index,timestamp_s,status,submap,in_main_map,n_matches,n_inliers,latency_ms"
    path.write_text(f"{columns}\n2,0.1,tracked,0,1,200,150,20.0\n")
    (row,) = read_frames(path)
    assert (row.n_inliers, row.sigma_position_rel, row.sigma_scale) == (150, None, None)
    path.write_text(f"{columns},sigma_position_rel,sigma_scale\n2,0.1,tracked,0,1,200,150,20.0,0.1,\n")
    (row,) = read_frames(path)
    assert (row.sigma_position_rel, row.method, row.doubt) == (0.1, None, "")
