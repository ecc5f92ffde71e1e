"""What becomes of a run's results and its processes where something beside the system breaks."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from dualslam.core.camera.base import Camera
from dualslam.core.config.settings import Config
from dualslam.core.errors import OutputError
from dualslam.core.jobs import InlineDesk
from dualslam.core.trajectory import Trajectory
from dualslam.core.types import FloatArray, Frame
from dualslam.io.map_store import load_atlas
from dualslam.io.run_reading import read_frames
from dualslam.io.trajectory_files import read_tum
from dualslam.map.frame_records import FrameResult
from dualslam.run.session import run_to_folder
from dualslam.testing.point_world import CAMERA
from dualslam.workers.scheduled_desk import ScheduledDesk
from tests.cli.fakes import FakeSystem


class Unplugged:
    """Frames of a camera that is unplugged, which is no `InputError` in somebody's own sequence."""

    name, rate_hz, camera = "mine", 30.0, CAMERA

    def __init__(self, after: int) -> None:
        self.after = after

    def __iter__(self) -> Iterator[Frame]:
        for i in range(self.after):
            yield Frame(i, i / 30, np.zeros((4, 4), np.uint8))
        raise OSError("unplugged")


class ClosedDesk(ScheduledDesk):
    is_closed = False

    def close(self) -> None:
        self.is_closed = True


@pytest.fixture
def system() -> FakeSystem:
    system = FakeSystem({i: np.eye(4) for i in range(100)})
    system.desk = ClosedDesk(InlineDesk({}))
    return system


@pytest.fixture
def build(system: FakeSystem) -> Callable[[Config, Camera], FakeSystem]:
    return lambda config, camera: system


def raise_at_the_third(result: FrameResult) -> None:
    if result.index == 2:
        raise OSError("mine")


@pytest.mark.parametrize(
    ("after", "on_frame", "n_frames"), [(5, None, 5), (5, raise_at_the_third, 3)], ids=["sequence", "on_frame"]
)
def test_what_a_sequence_or_a_callback_raises_costs_no_results(
    system: FakeSystem,
    build: Callable[[Config, Camera], FakeSystem],
    tmp_path: Path,
    after: int,
    on_frame: Callable[[FrameResult], None] | None,
    n_frames: int,
) -> None:
    with pytest.raises(OSError, match="unplugged" if on_frame is None else "mine") as raised:
        run_to_folder(Config(), Unplugged(after), tmp_path / "run", build=build, on_frame=on_frame)  # type: ignore[arg-type]
    assert raised.value.__notes__ == [f"What was found until then is in {tmp_path / 'run'}."]
    assert system.n_finished == 1
    assert len(read_frames(tmp_path / "run" / "frames.csv")) == n_frames
    assert (tmp_path / "run" / "report.html").exists()


def test_frames_and_trajectory_are_written_while_a_run_goes_on(
    system: FakeSystem,
    build: Callable[[Config, Camera], FakeSystem],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("dualslam.run.session.SAVE_S", 0.0)
    monkeypatch.setattr("dualslam.run.session.SAVING_SHARE", np.inf)
    run, found = tmp_path / "run", []

    def look(result: FrameResult) -> None:
        time.sleep(0.05)
        if (run / "frames.csv").exists() and (run / "trajectory.txt").exists():
            found.append((len(read_frames(run / "frames.csv")), len(read_tum(run / "trajectory.txt"))))
            assert not (run / "summary.json").exists()

    with pytest.raises(OSError, match="unplugged"):
        run_to_folder(Config(), Unplugged(12), run, build=build, on_frame=look)  # type: ignore[arg-type]
    assert (1, 1) <= found[0] < found[-1] <= (12, 12)


class WithTruth:
    """Somebody's own frames, whose ground truth or times are not what they should be."""

    name, rate_hz, camera = "mine", 30.0, CAMERA

    def __init__(self, truth_s: FloatArray, T_world_cam: FloatArray, step_s: float) -> None:
        self.ground_truth = Trajectory(truth_s, T_world_cam)
        self._step_s = step_s

    def __iter__(self) -> Iterator[Frame]:
        for i in range(12):
            yield Frame(i, i * self._step_s, np.zeros((4, 4), np.uint8))


TIMES_S, STILL = np.arange(12) / 30, np.tile(np.eye(4), (12, 1, 1))


@pytest.mark.parametrize(
    ("truth_s", "T_world_cam", "step_s"),
    [
        (TIMES_S + 1.6e9, STILL, 1 / 30),
        (np.zeros(0), np.zeros((0, 4, 4)), 1 / 30),
        (TIMES_S, np.full((12, 4, 4), np.nan), 1 / 30),
        (TIMES_S, STILL, 0.0),
    ],
    ids=["another clock", "empty", "not a number", "frames of one time"],
)
def test_a_truth_that_is_of_no_use_costs_its_errors_alone(
    build: Callable[[Config, Camera], FakeSystem],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    truth_s: FloatArray,
    T_world_cam: FloatArray,
    step_s: float,
) -> None:
    sequence = WithTruth(truth_s, T_world_cam, step_s)
    outcome = run_to_folder(Config(), sequence, tmp_path / "run", build=build)  # type: ignore[arg-type]
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["posed"] == 12
    assert summary["no_errors"] in caplog.text
    assert "ate_rmse_m" not in summary
    assert load_atlas(outcome.out).poses.keys() == set(range(12))
    assert (outcome.out / "report.html").exists()
    assert not (outcome.out / "groundtruth.txt").exists()


def test_a_truth_of_no_numbers_costs_a_run_without_a_map_nothing(tmp_path: Path) -> None:
    nowhere = FakeSystem({}, lost=tuple(range(12)))
    nowhere.desk = ClosedDesk(InlineDesk({}))
    partly = STILL.copy()
    partly[:6] = np.nan
    sequence = WithTruth(TIMES_S, partly, 1 / 30)
    outcome = run_to_folder(Config(), sequence, tmp_path / "run", build=lambda *_: nowhere)  # type: ignore[arg-type,return-value]
    assert not outcome.has_map
    assert len(read_tum(outcome.out / "groundtruth.txt")) == 6
    assert (outcome.out / "report.html").exists()


def test_no_process_outlives_a_run_that_ends_before_its_first_frame_or_has_no_folder(
    system: FakeSystem, build: Callable[[Config, Camera], FakeSystem], tmp_path: Path
) -> None:
    with pytest.raises(OSError, match="unplugged"):
        run_to_folder(Config(), Unplugged(0), tmp_path / "run", build=build)  # type: ignore[arg-type]
    assert system.desk.is_closed  # type: ignore[attr-defined]
    system.desk = ClosedDesk(InlineDesk({}))
    (tmp_path / "file").touch()
    with pytest.raises(OutputError):
        run_to_folder(Config(), Unplugged(5), tmp_path / "file" / "run", build=build)  # type: ignore[arg-type]
    assert system.desk.is_closed
