"""A run repeated from its folder."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from dualslam.build import build_system
from dualslam.cli import main
from dualslam.core.camera.base import Camera
from dualslam.core.config.files import load_config
from dualslam.core.config.settings import Config
from dualslam.core.jobs import JobKind
from dualslam.core.schedule import After, Recorded
from dualslam.core.types import Frame
from dualslam.lab.synthetic import make_sequence, render_to_folder
from dualslam.run.schedule import as_recorded
from dualslam.run.session import Outcome, run_to_folder
from dualslam.run.sources import open_source
from dualslam.system.system import System
from dualslam.testing.lossy import Lossy

SOURCE = "synthetic:street,frames=46,seed=5"
LOSS = [
    "frontend.n_features=500",
    "recovery.workers=1",
    "recovery.attempts=[live]",
    "corruptions=[{kind: blackout, start: 22, length: 6}]",
    "tracking.max_lost_s=0.1",
]


def test_a_repetition_sees_the_frames_that_the_run_has_seen() -> None:
    record = Recorded({}, {}, dropped=frozenset({1, 3}), last_frame=4)
    handed = list(as_recorded(iter([Frame(i, i / 10, None) for i in range(9)]), record))
    assert [each.frame.index for each in handed] == [0, 2, 4]
    assert [[late.index for late in each.dropped] for each in handed] == [[], [1], [3]]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--realtime"], "leave out --realtime"),
        (["--workers", "2"], "leave out --realtime"),
        ([], "takes the folder of a run that has left its schedule"),
    ],
)
def test_what_cannot_be_repeated_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], says: str
) -> None:
    replay = ["--replay", str(tmp_path / "none"), "--out", str(tmp_path / "out")]
    assert main(["run", SOURCE, *replay, *options]) == 2
    assert says in capsys.readouterr().err


def lossy_run(source: str, folder: Path) -> Outcome:
    """A run with a loss, under a schedule of its own, of whose jobs some are lost."""

    def build(config: Config, camera: Camera) -> System:
        schedule = After({JobKind.GRAPH: 3, JobKind.CALIBRATION: 7, JobKind.WALK: 4, JobKind.LOOP: 2})
        system = build_system(config, camera, schedule=schedule, in_process=True)
        system.desk.executor = Lossy([JobKind.GRAPH, JobKind.LOOP], every=5).around(system.desk.executor)
        return system

    return run_to_folder(load_config(None, LOSS), open_source(source), folder, build=build)


@pytest.mark.slow
def test_a_run_is_repeated_to_the_bit_and_another_source_comes_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, run = render_to_folder(make_sequence("street", 46, 5, 320, 240), tmp_path / "street"), tmp_path / "run"
    lossy_run(str(source), run)
    rows = [json.loads(line) for line in (run / "schedule.jsonl").read_text().splitlines()]
    assert {"ok", "worker"} <= {row["outcome"] for row in rows if "outcome" in row}
    assert main(["run", str(source), "--replay", str(run), "--out", str(tmp_path / "again")]) == 0
    assert "the same trajectory, bit for bit" in capsys.readouterr().out
    assert (run / "trajectory.txt").read_bytes() == (tmp_path / "again" / "trajectory.txt").read_bytes()
    images = sorted((source / "images").iterdir())
    blank = np.zeros_like(cv2.imread(str(images[0])))
    for image in images[12:18]:
        cv2.imwrite(str(image), blank)
    main(["run", str(source), "--replay", str(run), "--out", str(tmp_path / "other")])
    told = capsys.readouterr()
    assert "another trajectory; it comes apart at frame" in told.out
    replay = json.loads((tmp_path / "other" / "summary.json").read_text())["replay"]
    assert not replay["same_trajectory"]
    assert replay["departure"].startswith("frame ")
