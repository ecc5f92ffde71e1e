"""What a person may hand to the Python interface by mistake is refused in one sentence."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import dualslam
from dualslam.core.camera.models import camera_from_fov
from dualslam.core.interfaces import Sequence
from dualslam.core.types import Frame
from dualslam.testing.point_world import CAMERA


def system() -> dualslam.System:
    return dualslam.build_system(dualslam.Config(), CAMERA)


def sequence() -> Sequence:
    return dualslam.open_source("synthetic:room,frames=2,width=64,height=48")


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (lambda _: dualslam.build_system({"seed": 1}, CAMERA), "the configuration is a dict"),
        (lambda _: dualslam.build_system(dualslam.Config(), np.eye(3)), "the camera is a ndarray"),
        (lambda _: dualslam.build_system(dualslam.Config(), CAMERA, saved="runs/a"), "load_atlas reads one"),
        (lambda _: camera_from_fov(640, 480, "70"), "field of view is .70. degrees"),
        (lambda here: dualslam.open_source(here, max_frames=10.0), "max_frames is 10.0; it must be a whole number"),
        (lambda here: dualslam.run_to_folder(dualslam.Config(), [], here), "the sequence is a list; open_source"),
        (lambda here: dualslam.trajectories_of(here), "takes a system, not a PosixPath; of a run folder, read_run"),
        (lambda here: dualslam.report_page(here), "is not the folder of a finished run"),
        (lambda here: dualslam.comparison_page([here]), "is not the folder of a finished run"),
        (lambda _: dualslam.dump_config({"seed": 1}), "the configuration is a dict; load_config or config_from_dict"),
        (lambda _: dualslam.evaluate_run([], sequence()), "the run is a list; give the path of its folder"),
        (lambda here: dualslam.evaluate_run(here, []), "the sequence is a list; open_source opens one"),
        (lambda _: system().step(np.zeros((4, 4), np.uint8)), r"step takes a dualslam.Frame\("),
    ],
)
def test_one_sentence(tmp_path: Path, act: Callable[[Path], object], words: str) -> None:
    with pytest.raises(dualslam.DualSlamError, match=words):
        act(tmp_path)


def test_a_run_that_has_ended_takes_no_frame() -> None:
    ended = system()
    ended.step(Frame(0, 0.0, None))
    with pytest.raises(dualslam.InputError, match="frame 0 comes after frame 0"):
        ended.step(Frame(0, 0.0, None))
    assert list(ended.rows) == [0]
    ended.finish()
    with pytest.raises(dualslam.InputError, match="build another system"):
        ended.step(Frame(1, 0.1, None))
