from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

from dualslam.cli import main
from dualslam.core.config.files import load_config
from dualslam.core.errors import OutputError
from dualslam.core.events import Event, EventKind
from dualslam.core.jobs import InlineDesk
from dualslam.core.types import Frame
from dualslam.io.map_store import load_atlas, save_atlas
from dualslam.io.run_folder import RunFolder
from dualslam.io.run_reading import read_events
from dualslam.lab.synthetic import SyntheticSequence
from dualslam.run.results import versions
from dualslam.run.session import run_to_folder
from dualslam.run.sources import open_source
from tests.cli.conftest import N_FRAMES
from tests.cli.fakes import FakeSystem
from tests.io.test_bags import Writer, rgb_of, write_bag

Install = Callable[..., None]


def rows_of(out: Path) -> list[dict[str, str]]:
    with (out / "frames.csv").open() as file:
        return list(csv.DictReader(file))


def test_a_run_leaves_all_that_it_should(
    folder: Path, fake: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert main(["run", str(folder), "--out", str(out), "--seed", "3"]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    line, verdict, pages = captured.out.splitlines()
    assert f"coverage 100.0 % ({N_FRAMES} of {N_FRAMES} frames), 1 submap, 0 failures, ATE" in line
    assert line.endswith(f"results in {out}")
    assert verdict == "verdict: good."
    assert pages == f"open {out / 'report.html'} and {out / 'map.html'}"
    judged = json.loads((out / "summary.json").read_text())["verdict"]
    assert (judged["level"], judged["reasons"]) == ("good", [])
    assert judged["scores"]["jump"] < 0.1
    assert len(rows_of(out)) == len((out / "trajectory.txt").read_text().splitlines()) == N_FRAMES
    assert np.load(out / "covariances.npz")["covariance"].shape == (N_FRAMES, 6, 6)
    assert all(row["in_main_map"] == "1" and row["status"] == "tracked" for row in rows_of(out))
    assert json.loads((out / "events.jsonl").read_text().splitlines()[0])["event"] == "initialised"
    assert load_config(out / "config.yaml") == load_config(None, ["seed=3", "frontend.name=orb"])
    summary = json.loads((out / "summary.json").read_text())
    assert summary["coverage"] == 1.0
    assert summary["seed"] == 3
    assert summary["no_map"] is None
    assert summary["ate_rmse_m"] < 1e-6
    assert set(summary["latency_ms"]) == {"median", "p95", "p99", "max"}
    assert {"numpy", "gtsam", "dualslam", "python"} <= set(summary["versions"])
    for field in ("frames", "posed", "failures", "recoveries", "submaps", "links", "fps", "recovery_s", "peak_rss_mb"):
        assert field in summary


def test_decisions_are_written_where_they_are_asked_for(
    folder: Path, fake: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, options in (("without", []), ("with", ["--decisions"])):
        assert main(["run", str(folder), "--out", str(tmp_path / name), "--quiet", *options]) == 0
    assert not (tmp_path / "without" / "decisions.jsonl").exists()
    started = json.loads((tmp_path / "with" / "decisions.jsonl").read_text().splitlines()[0])
    assert (started["what"], started["accepted"]) == ("start", True)
    capsys.readouterr()
    assert main(["explain", str(tmp_path / "with"), "--frame", str(started["frame"])]) == 0
    assert "A map starts." in capsys.readouterr().out


def test_versions_name_an_extra_that_is_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("torch", "kornia"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    assert not {"torch", "kornia"} & versions().keys()
    monkeypatch.setitem(sys.modules, "torch", ModuleType("torch"))
    assert "torch" in versions()
    assert "kornia" not in versions()


def test_a_lost_track_leaves_two_labelled_submaps(
    folder: Path, fake: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fake(lost=(10, 11))
    assert main(["run", str(folder), "--out", str(tmp_path / "run")]) == 0
    n_main = N_FRAMES - 12
    assert f"({n_main} of {N_FRAMES} frames), 2 submaps, 1 failure" in capsys.readouterr().out
    rows = rows_of(tmp_path / "run")
    assert [row["status"] for row in rows[9:13]] == ["tracked", "lost", "lost", "tracked"]
    assert [row["in_main_map"] for row in rows] == ["0"] * 12 + ["1"] * n_main
    assert len((tmp_path / "run" / "submaps" / "00.txt").read_text().splitlines()) == 10
    assert not (tmp_path / "run" / "submaps" / "01.txt").exists()
    stored = load_atlas(tmp_path / "run")
    assert list(stored.atlas.submaps) == [0, 1]
    assert set(stored.poses) == set(range(N_FRAMES)) - {10, 11}


def test_an_earlier_run_is_not_overwritten_without_being_told(
    folder: Path, fake: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["run", str(folder), "--out", str(tmp_path / "run"), "--quiet"]
    assert main(command) == 0
    (tmp_path / "run" / "notes.txt").write_text("mine")
    assert main(command) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main([*command, "--overwrite", "--max-frames", "15"]) == 0
    assert len(rows_of(tmp_path / "run")) == 15
    assert (tmp_path / "run" / "notes.txt").read_text() == "mine"
    captured = capsys.readouterr()
    assert captured.out == captured.err == ""


def test_a_folder_that_is_taken_is_refused_before_the_camera_is_searched_for(
    folder: Path, fake: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(folder), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    monkeypatch.setattr("dualslam.cli.run_command.with_camera_found", lambda *_: pytest.fail("long work for nothing"))
    assert main(["run", str(folder / "images"), "--out", str(tmp_path / "run"), "--quiet"]) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_a_torn_video_is_one_sentence_and_no_word_of_its_decoder(tmp_path: Path) -> None:
    """A process of its own: the decoder writes to stderr past Python."""
    (tmp_path / "torn.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(500))
    command = [sys.executable, "-m", "dualslam.cli", "run", tmp_path / "torn.mp4", "--out", tmp_path / "run"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.splitlines() == [done.stderr.rstrip()]
    assert done.stderr.startswith(f"dualslam: {tmp_path / 'torn.mp4'} is no video that OpenCV can open")


@pytest.mark.slow
def test_damaged_images_are_told_by_our_sentences_alone(folder: Path, tmp_path: Path) -> None:
    """A process of its own: decoders write to stderr past Python, and so does numpy of a calibration gone wild."""
    images = sorted((folder / "images").iterdir())[:4]
    copy = tmp_path / "images"
    copy.mkdir()
    for name, image in zip(("0.png", "1.png", "2.jpg", "3.png"), images, strict=True):
        data = cv2.imencode(Path(name).suffix, cv2.imread(str(image)))[1].tobytes()
        middle = len(data) // 2
        damaged = data if name in ("0.png", "3.png") else data[:middle] + bytes(60) + data[middle + 60 :]
        (copy / name).write_bytes(damaged)
    (copy / "times.txt").write_text("0.0\n0.1\n0.2\n0.3\n")
    command = [sys.executable, "-m", "dualslam.cli", "run", copy, "--fov", "70", "--out", tmp_path / "run"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stderr == (
        f"WARNING dualslam.io.sequence: frame 1: {copy / '1.png'} cannot be decoded: it is damaged or no image.\n"
    )
    done = subprocess.run([*command, "--overwrite", "-v"], capture_output=True, text=True, check=False)
    assert "libpng" in done.stderr, "with -v all is told"


def test_a_quiet_run_without_a_map_says_why(
    folder: Path, fake: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fake(lost=tuple(range(N_FRAMES)))
    out = tmp_path / "run"
    assert main(["run", str(folder), "--out", str(out), "--quiet"]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err == f"dualslam: no map; results in {out}\n"


@pytest.mark.slow
def test_letters_that_the_locale_lacks_stop_nothing(tmp_path: Path) -> None:
    """A process of its own, as the locale is the process's. A name that is no ASCII comes in as bytes."""
    out = tmp_path / "мой сон"
    command = [sys.executable, "-m", "dualslam.cli", "run", "synthetic:street,frames=2", "--out", out]
    ascii_only = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "ascii:strict"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, **ascii_only})
    assert (done.returncode, done.stderr) == (1, "")
    assert done.stdout.startswith("no map: ")
    assert (out / "report.html").exists()


def test_the_frames_that_were_asked_for(folder: Path, fake: Install, tmp_path: Path) -> None:
    options = ["--start", "3", "--stride", "2", "--max-frames", "4", "--reverse", "--quiet"]
    assert main(["run", str(folder), "--out", str(tmp_path / "run"), *options]) == 0
    assert [row["index"] for row in rows_of(tmp_path / "run")] == ["9", "7", "5", "3"]
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["selection"] == {"start": 3, "stride": 2, "max_frames": 4, "reverse": True}
    assert summary["realtime"] is False
    assert summary["camera"] == open_source(folder).camera.to_dict()
    source = f"synthetic:street,frames={N_FRAMES},seed=1"
    assert main(["run", source, "--out", str(tmp_path / "world"), *options]) == 0
    assert [row["index"] for row in rows_of(tmp_path / "world")] == ["9", "7", "5", "3"]


def test_no_map_is_status_1_and_a_row_for_every_frame(
    folder: Path, fake: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fake(lost=tuple(range(N_FRAMES)))
    assert main(["run", str(folder), "--out", str(tmp_path / "run")]) == 1
    assert capsys.readouterr().out.startswith("no map: coverage 0.0 %")
    assert len(rows_of(tmp_path / "run")) == N_FRAMES
    assert (tmp_path / "run" / "trajectory.txt").read_text() == ""


def test_why_there_is_no_map_is_told_in_every_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    assert main(["run", "synthetic:street,frames=2", "--out", str(out)]) == 1
    why = "too short: 2 images"
    assert f"; {why}; results in {out}" in capsys.readouterr().out
    assert json.loads((out / "summary.json").read_text())["no_map"] == why
    assert f"none of 2 frames has a pose; {why}." in (out / "report.html").read_text()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_keeps_what_it_has(
    folder: Path, fake: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str], number: int
) -> None:
    def interrupt(frame: Frame) -> None:
        if frame.index == 6:
            os.kill(os.getpid(), number)

    fake(before_step=interrupt)
    before = signal.getsignal(number)
    assert main(["run", str(folder), "--out", str(tmp_path / "run")]) == 130
    assert signal.getsignal(number) is before
    told, _, _, how = capsys.readouterr().out.splitlines()
    assert told.startswith("interrupted: coverage 100.0 % (7 of 7 frames)")
    assert f"--start 7, --map {tmp_path / 'run'}" in how
    assert len(rows_of(tmp_path / "run")) == 7
    events = (tmp_path / "run" / "events.jsonl").read_text().splitlines()
    assert json.loads(events[-1])["event"] == "interrupted"
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["interrupted"] is True


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_who_interrupts_twice_keeps_it_too(folder: Path, fake: Install, tmp_path: Path, number: int) -> None:
    def interrupt(frame: Frame) -> None:
        if frame.index == 6:
            os.kill(os.getpid(), number)
            os.kill(os.getpid(), number)
            pytest.fail("the second one leaves the frame in hand")

    fake(before_step=interrupt)
    assert main(["run", str(folder), "--out", str(tmp_path / "run"), "--quiet"]) == 130
    assert len(rows_of(tmp_path / "run")) == 6
    assert set(load_atlas(tmp_path / "run").poses) == set(range(6))


def test_who_leaves_the_end_of_a_run_keeps_the_pictures_of_its_last_gap_and_no_worker(
    folder: Path, fake: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object) -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        pytest.fail("the second one leaves the end")

    fake(lost=(N_FRAMES - 2, N_FRAMES - 1))
    monkeypatch.setattr(FakeSystem, "finish", interrupted)
    closed: list[bool] = []
    monkeypatch.setattr(InlineDesk, "close", lambda _: closed.append(True))
    assert main(["run", str(folder), "--out", str(tmp_path / "run")]) == 130
    told, _, _ = capsys.readouterr().out.splitlines()  # and nothing of how to go on: all frames were seen
    assert told.startswith("interrupted: coverage ")
    kept = sorted(int(path.stem) for path in (tmp_path / "run" / "samples").iterdir())
    assert kept == [N_FRAMES - 3, N_FRAMES - 2, N_FRAMES - 1]
    assert closed, "its workers are ended"


def test_an_interrupt_while_results_are_written_waits_for_them(
    folder: Path, fake: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*args: object) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        save_atlas(*args)  # type: ignore[arg-type]

    monkeypatch.setattr("dualslam.run.session.save_atlas", interrupted)
    assert main(["run", str(folder), "--out", str(tmp_path / "run")]) == 130
    said = capsys.readouterr().err
    assert "the results are being written; two more of these signals would leave them unfinished" in said
    assert said.endswith(f"dualslam: interrupted. All results are in {tmp_path / 'run'}.\n")
    assert len(load_atlas(tmp_path / "run").poses) == N_FRAMES
    assert (tmp_path / "run" / "report.html").exists()


def test_who_leaves_the_writing_of_results_is_told_what_is_there(
    folder: Path, fake: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*args: object) -> None:
        for _ in range(3):
            os.kill(os.getpid(), signal.SIGINT)

    out = tmp_path / "run"
    monkeypatch.setattr("dualslam.run.session.save_atlas", interrupted)
    assert main(["run", str(folder), "--out", str(out)]) == 130
    *warned, last = capsys.readouterr().err.splitlines()
    assert len(warned) == 2
    there = "config.yaml, events.jsonl, schedule.jsonl, frames.csv, trajectory.txt, summary.json, groundtruth.txt"
    assert last == f"dualslam: interrupted. In {out} are {there}; not written: map/, report.html."
    assert len(rows_of(out)) == N_FRAMES


def test_who_looks_on_sees_the_end_that_was_left(folder: Path, tmp_path: Path, world: SyntheticSequence) -> None:
    class Leaves(FakeSystem):
        def finish(self, interrupted: bool = False) -> None:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)

    ended: list[bool] = []
    watcher = Mock(is_paused=lambda: False, end=lambda: ended.append(True))
    build: Any = lambda *_: Leaves(dict(enumerate(world.ground_truth_T_world_cam)))  # noqa: E731
    outcome = run_to_folder(load_config(), open_source(folder), tmp_path / "run", build=build, watcher=watcher)
    assert outcome.report.interrupted
    assert ended == [True]


def test_a_disk_that_is_full_for_a_while_ends_the_run_and_costs_nothing_else(
    folder: Path, fake: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    append, full = RunFolder.append_event, [True]

    def fill_up(written_to: RunFolder, event: Event) -> None:
        if event.event is EventKind.FAILED and full.pop():
            raise OutputError("events.jsonl cannot be written: No space left on device.")
        append(written_to, event)

    fake(lost=(6, 7))
    full.insert(0, False)
    monkeypatch.setattr(RunFolder, "append_event", fill_up)
    out = tmp_path / "run"
    assert main(["run", str(folder), "--out", str(out)]) == 2
    said = (
        f"dualslam: events.jsonl cannot be written: No space left on device. What was found until then is in {out}.\n"
    )
    assert capsys.readouterr().err == said
    assert len(rows_of(out)) == 7
    assert [event["event"] for event in read_events(out / "events.jsonl")] == ["initialised", "failed"]


def test_a_run_folder_that_is_removed_while_the_run_goes_on_costs_nothing(
    folder: Path, fake: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"

    def remove(frame: Frame) -> None:
        if frame.index == 12:
            shutil.rmtree(out)

    fake(lost=(6, 7), before_step=remove)
    assert main(["run", str(folder), "--out", str(out)]) == 0
    assert "was removed while the run went on" in capsys.readouterr().err
    assert [event["event"] for event in read_events(out / "events.jsonl")] == ["initialised", "failed", "initialised"]
    assert len(rows_of(out)) == N_FRAMES
    assert {"config.yaml", "trajectory.txt", "map", "report.html"} <= {path.name for path in out.iterdir()}


def test_a_bug_in_the_system_leaves_its_log_in_the_run_folder(
    folder: Path, fake: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(frame: Frame) -> None:
        raise ZeroDivisionError("by zero")

    fake(before_step=broken)
    assert main(["run", str(folder), "--out", str(tmp_path / "run")]) == 1
    assert "this is a bug" in capsys.readouterr().err
    (log,) = (tmp_path / "run").glob("dualslam-bug-*.log")
    assert "ZeroDivisionError: by zero" in log.read_text()


def test_a_crash_in_the_middle_keeps_what_was_found(
    folder: Path, fake: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(frame: Frame) -> None:
        if frame.index == 6:
            raise ZeroDivisionError("by zero")

    out = tmp_path / "run"
    fake(before_step=broken)
    assert main(["run", str(folder), "--out", str(out)]) == 1
    message = capsys.readouterr().err
    assert "this is a bug, please report it: ZeroDivisionError: by zero" in message
    assert message.rstrip().endswith(f"What was found until then is in {out}.")
    assert len(rows_of(out)) == len((out / "trajectory.txt").read_text().splitlines()) == 6
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["crashed"], summary["frames"], summary["posed"]) == (True, 7, 6)
    assert set(load_atlas(out).poses) == set(range(6))
    assert "This run crashed" in (out / "report.html").read_text()
    (log,) = out.glob("dualslam-bug-*.log")
    assert "in broken" in log.read_text()


def test_profile_prints_a_table(
    folder: Path, fake: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(folder), "--out", str(tmp_path / "run"), "--profile"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["stage", "calls", "CPU", "s", "ms/frame", "share", "wall", "s", "longest", "ms"]
    assert any(line.startswith("tracking ") for line in lines)
    assert any(line.startswith("whole, all processes") for line in lines)


def test_eval_gives_coverage_first(
    folder: Path, fake: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fake(lost=(11,))
    run = str(tmp_path / "run")
    assert main(["run", str(folder), "--out", run, "--quiet"]) == 0
    assert main(["eval", run, str(folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"main map: coverage 50.0 % (12 of {N_FRAMES} frames)"
    assert lines[1].startswith("  ATE 0.0000 m RMSE")
    assert any(line.startswith("submap 0, not linked: coverage 45.8 %") for line in lines)
    assert main(["eval", run, str(folder), "--json"]) == 0
    score = json.loads(capsys.readouterr().out)
    assert score["coverage_pct"] == 50.0
    assert score["submaps"][0]["submap"] == 0
    assert main(["eval", run, f"synthetic:street,frames={N_FRAMES},seed=1"]) == 0


def test_eval_against_another_sequence_is_bad_input(
    folder: Path, fake: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, later = tmp_path / "run", tmp_path / "later"
    assert main(["run", str(folder), "--out", str(run), "--quiet"]) == 0
    shutil.copytree(folder, later)
    for name in ("times.txt", "groundtruth_tum.txt"):
        rows = np.loadtxt(later / name, ndmin=2)
        rows = rows.reshape(-1, 1) if name == "times.txt" else rows
        rows[:, 0] += 1000.0
        np.savetxt(later / name, rows, fmt="%.9f")
    assert main(["eval", str(run), str(later)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "has frames at other times" in captured.err
    shutil.copytree(folder, tmp_path / "mirrored")
    for path in sorted((tmp_path / "mirrored" / "images").iterdir()):
        cv2.imwrite(str(path), cv2.imread(str(path))[:, ::-1])
    assert main(["eval", str(run), str(tmp_path / "mirrored")]) == 2
    assert "shows other images" in capsys.readouterr().err


def test_eval_honours_the_frames_that_were_chosen(
    folder: Path, fake: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = str(tmp_path / "run")
    chosen = ["--start", "3", "--stride", "2", "--max-frames", "10"]
    assert main(["run", str(folder), "--out", run, "--quiet", *chosen]) == 0
    assert main(["eval", run, str(folder)]) == 0
    assert capsys.readouterr().out.startswith("main map: coverage 100.0 % (10 of 10 frames)")


def test_eval_of_keyframes_and_of_a_camera_that_returns(
    folder: Path, fake: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = str(tmp_path / "run")
    assert main(["run", str(folder), "--out", run, "--quiet"]) == 0
    n_keyframes = len({k for submap in load_atlas(run).atlas.submaps.values() for k in submap.keyframes})
    assert main(["eval", run, str(folder), "--keyframes-only", "--json"]) == 0
    score = json.loads(capsys.readouterr().out)
    assert (score["posed"], score["keyframes"]["posed"]) == (N_FRAMES, n_keyframes)
    assert main(["eval", run, str(folder), "--keyframes-only"]) == 0
    assert f"({n_keyframes} poses)" in capsys.readouterr().out
    (folder / "groundtruth_tum.txt").rename(tmp_path / "truth")
    try:
        assert main(["eval", run, str(folder), "--returns", "--json"]) == 0
    finally:
        (tmp_path / "truth").rename(folder / "groundtruth_tum.txt")
    score = json.loads(capsys.readouterr().out)
    xyz = np.loadtxt(tmp_path / "run" / "trajectory.txt")[:, 1:4]
    way = np.linalg.norm(np.diff(xyz, axis=0), axis=1).sum()
    assert score["end_to_start_pct"] == pytest.approx(100 * np.linalg.norm(xyz[-1] - xyz[0]) / way, rel=1e-6)
    assert 0 <= score["end_to_start_deg"] <= 180


def test_eval_needs_no_calibration(
    folder: Path, fake: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, bare = tmp_path / "run", tmp_path / "bare"
    assert main(["run", str(folder), "--out", str(run), "--quiet"]) == 0
    shutil.copytree(folder, bare)
    (bare / "calib.txt").unlink()
    assert main(["eval", str(run), str(bare)]) == 0
    assert capsys.readouterr().out.startswith(f"main map: coverage 100.0 % ({N_FRAMES} of {N_FRAMES} frames)")
    (bare / "groundtruth_tum.txt").unlink()
    for sequence, words in ((str(bare), "bare has no ground truth"), ("0", "0 is live: it has no ground truth")):
        assert main(["eval", str(run), sequence]) == 2
        assert words in capsys.readouterr().err


def test_eval_reads_the_topic_that_the_run_has_read(fake: Install, tmp_path: Path) -> None:
    def fill(writer: Writer) -> None:
        for i in range(N_FRAMES):
            writer.image("/left/image_raw", i, rgb_of(i), "rgb8")
            writer.image("/right/image_raw", i, rgb_of(i), "rgb8")

    bag, run = str(write_bag(tmp_path / "drive", "mcap", fill)), str(tmp_path / "run")
    assert main(["run", bag, "--topic", "/left/image_raw", "--fov", "60", "--out", run, "--quiet"]) == 0
    assert main(["eval", run, bag, "--returns"]) == 0


def test_render_writes_a_sequence_and_overwrites_only_its_own(
    tmp_path: Path, world: SyntheticSequence, capsys: pytest.CaptureFixture[str]
) -> None:
    out, script = tmp_path / "room", tmp_path / "events.yaml"
    script.write_text("- {kind: drop, start: 2, length: 1}\n- {kind: blur, start: 3, length: 1, strength: 4}\n")
    command = ["render", "room", "--out", str(out), "--frames", "5", "--events", str(script)]
    assert main(command) == 0
    assert "4 frames of synthetic_room_0" in capsys.readouterr().out
    assert len(list((out / "images").iterdir())) == len(np.loadtxt(out / "times.txt")) == 4
    assert main(command) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main([*command[:4], "--frames", "2", "--overwrite", "--quiet"]) == 0
    assert len(list((out / "images").iterdir())) == 2
    (out / "SOURCE.md").write_text("mine")
    assert main([*command[:4], "--frames", "2", "--overwrite"]) == 2
    assert "not written by dualslam render" in capsys.readouterr().err
    assert len(list((out / "images").iterdir())) == 2
