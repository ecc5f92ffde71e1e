"""Trajectories to the disk and back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface

from dualslam.core.errors import InputError, OutputError
from dualslam.core.geometry import so3
from dualslam.io import Trajectory, read_kitti, read_tum, write_kitti, write_tum
from dualslam.io.atomic import atomic_file
from dualslam.io.trajectory_files import associate


@pytest.fixture
def trajectory() -> Trajectory:
    rng = np.random.default_rng(7)
    n = 40
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = so3.exp(rng.normal(0, 1.5, (n, 3)))
    T[:, :3, 3] = rng.normal(0, 10, (n, 3)) * 10.0 ** rng.integers(-9, 4, (n, 1))
    times = 1403636579.763555584 + np.cumsum(rng.uniform(1e-4, 1, n))
    return Trajectory(times, T)


def test_tum_round_trip(tmp_path: Path, trajectory: Trajectory) -> None:
    path = tmp_path / "sub" / "t.txt"
    write_tum(path, trajectory)
    back = read_tum(path)
    assert back.timestamps_s.tobytes() == trajectory.timestamps_s.tobytes()
    assert back.T_world_cam[:, :3, 3].tobytes() == trajectory.T_world_cam[:, :3, 3].tobytes()
    np.testing.assert_allclose(back.T_world_cam, trajectory.T_world_cam, atol=1e-14)
    lines = path.read_text().splitlines()
    assert len(lines) == len(trajectory), "one line for every frame, no header"
    assert all(len(line.split()[0].split(".")[1]) >= 9 for line in lines)
    assert "e" not in path.read_text(), "plain decimals: not every reader knows exponents"


def test_tum_is_what_evo_reads(tmp_path: Path, trajectory: Trajectory) -> None:
    path = tmp_path / "t.txt"
    write_tum(path, trajectory)
    evo = file_interface.read_tum_trajectory_file(str(path))
    np.testing.assert_array_equal(evo.timestamps, trajectory.timestamps_s)
    np.testing.assert_allclose(np.array(evo.poses_se3), trajectory.T_world_cam, atol=1e-12)


def test_kitti_round_trip(tmp_path: Path, trajectory: Trajectory) -> None:
    path, frames_path = tmp_path / "k.txt", tmp_path / "k_frames.txt"
    frames = np.arange(len(trajectory)) * 3
    write_kitti(path, trajectory.T_world_cam, frames, frames_path)
    assert read_kitti(path).tobytes() == trajectory.T_world_cam.tobytes()
    assert [int(line) for line in frames_path.read_text().splitlines()] == frames.tolist()
    evo = file_interface.read_kitti_poses_file(str(path))
    np.testing.assert_array_equal(np.array(evo.poses_se3), trajectory.T_world_cam)


def test_no_poses(tmp_path: Path) -> None:
    write_tum(tmp_path / "t.txt", Trajectory(np.zeros(0), np.zeros((0, 4, 4))))
    assert (tmp_path / "t.txt").read_text() == ""
    assert len(read_tum(tmp_path / "t.txt", allow_empty=True)) == 0
    with pytest.raises(InputError, match=r"t\.txt is empty"):
        read_tum(tmp_path / "t.txt")
    write_kitti(tmp_path / "k.txt", np.zeros((0, 4, 4)), [], tmp_path / "f.txt")


def test_reading_sorts_by_time_and_takes_any_norm(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    path.write_text("# t tx ty tz qx qy qz qw\n2,0,0,0,0,0,0,2\n\n1 5 0 0 0 0 2 0 # turned\n")
    trajectory = read_tum(path)
    assert trajectory.timestamps_s.tolist() == [1, 2]
    np.testing.assert_allclose(trajectory.T_world_cam[0, :3, :3], np.diag([-1, -1, 1]), atol=1e-15)
    np.testing.assert_allclose(trajectory.T_world_cam[1], np.eye(4), atol=1e-15)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("1 0 0 0 0 0 0\n", "line 1: 7 numbers where 8"),
        ("1 0 0 0 0 0 0 x\n", "line 1"),
        ("1 nan 0 0 0 0 0 1\n", "pose 1 holds a value that is not finite"),
        ("1 0 0 0 0 0 0 0\n", "quaternion of pose 1"),
        ("\xff\xfe", "line 1"),
    ],
)
def test_bad_tum(tmp_path: Path, content: str, words: str) -> None:
    path = tmp_path / "t.txt"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=words):
        read_tum(path)


def test_bad_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        read_tum(tmp_path / "none.txt")
    with pytest.raises(InputError, match="cannot be read"):
        read_tum(tmp_path)
    (tmp_path / "b.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not a text file"):
        read_tum(tmp_path / "b.txt")
    (tmp_path / "k.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 inf\n")
    with pytest.raises(InputError, match="not finite"):
        read_kitti(tmp_path / "k.txt")


def test_nothing_senseless_is_written(tmp_path: Path) -> None:
    bad = np.full((1, 4, 4), np.nan)
    with pytest.raises(OutputError, match="not finite"):
        write_tum(tmp_path / "t.txt", Trajectory(np.zeros(1), bad))
    with pytest.raises(OutputError, match="1 poses for 2 frames"):
        write_kitti(tmp_path / "k.txt", np.eye(4)[None], [1, 2], tmp_path / "f.txt")
    assert not list(tmp_path.iterdir())


def test_an_interrupted_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    path.write_text("old")

    def interrupted() -> None:
        with atomic_file(path) as file:
            file.write(b"half of the new")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["t.txt"]


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"), atomic_file(tmp_path / "file" / "t.txt"):
        pass


def test_association_by_time() -> None:
    index, close = associate(np.array([0.0, 1.0, 2.0]), np.array([-5.0, 0.4, 0.5, 0.6, 1.999, 9.0]), 0.45)
    assert index.tolist() == [0, 0, 0, 1, 2, 2]
    assert close.tolist() == [False, True, False, True, True, False]
    assert associate(np.zeros(0), np.ones(2), 1.0)[1].tolist() == [False, False]
    assert associate(np.ones(1), np.array([1.2, 3.0]), 0.5)[1].tolist() == [True, False]
