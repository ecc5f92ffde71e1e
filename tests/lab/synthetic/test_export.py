"""A rendered folder holds what the sequence holds."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dualslam.core.config.corruption import Corruption, CorruptionKind
from dualslam.core.errors import OutputError
from dualslam.lab.synthetic import make_sequence, render_to_folder


def test_folder_round_trips(tmp_path: Path) -> None:
    events = (
        Corruption(kind=CorruptionKind.DROP, start=3, length=2),
        Corruption(kind=CorruptionKind.BLACKOUT, start=6, length=1),
    )
    sequence = make_sequence("room", n_frames=8, seed=1, width=96, height=72, events=events)
    out = render_to_folder(sequence, tmp_path / "run")
    names = sorted(p.name for p in (out / "images").iterdir())
    assert names == [f"{i:06d}.png" for i in sequence.indices]
    for frame in sequence:
        written = cv2.imread(str(out / "images" / f"{frame.index:06d}.png"), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(written, frame.image)
    times_s = np.loadtxt(out / "times.txt")
    assert np.allclose(times_s, sequence.timestamps_s[sequence.indices], atol=1e-6)
    fx, fy, cx, cy, width, height = np.loadtxt(out / "calib.txt")
    assert np.allclose([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], sequence.camera.K, rtol=1e-9)
    assert (width, height) == (96, 72)
    truth = np.loadtxt(out / "groundtruth_tum.txt")
    T_world_cam = sequence.ground_truth_T_world_cam[sequence.indices]
    assert np.allclose(truth[:, 0], times_s)
    assert np.allclose(truth[:, 1:4], T_world_cam[:, :3, 3], atol=1e-8)
    assert np.allclose(Rotation.from_quat(truth[:, 4:]).as_matrix(), T_world_cam[:, :3, :3], atol=1e-7)

    # SOURCE.md is a recipe that works.
    code = (out / "SOURCE.md").read_text().split("```python\n")[1].split("render_to_folder(")[0]
    again: dict[str, object] = {}
    exec(code + "\nimage = sequence.frame(5).image", {}, again)
    assert np.array_equal(again["image"], sequence.frame(5).image)


def test_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    sequence = make_sequence("room", n_frames=1, width=64, height=48)
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "file").write_text("")
    with pytest.raises(OutputError, match="not an empty folder"):
        render_to_folder(sequence, tmp_path / "used")
    with pytest.raises(OutputError, match="cannot be written"):
        render_to_folder(sequence, tmp_path / "used" / "file" / "below")
