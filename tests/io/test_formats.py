"""Each layout is recognised, and gives its frames, times, camera and truth."""

from __future__ import annotations

import json
import logging
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from dualslam.core.camera.models import FovCamera, PinholeCamera, RadTanCamera
from dualslam.core.errors import InputError
from dualslam.io import open_sequence

N = 6


@pytest.mark.parametrize("layout", ["dataset", "kitti", "tum_rgbd", "tum_mono", "euroc"])
def test_every_layout_gives_all_its_frames_in_order(make, image_number, tmp_path: Path, layout: str) -> None:
    sequence = open_sequence(make[layout](tmp_path / "data"))
    frames = list(sequence)
    assert len(sequence) == N
    assert [f.index for f in frames] == list(range(N))
    assert [image_number(f.image) for f in frames] == list(range(N))
    assert [f.timestamp_s for f in frames] == sequence.frame_timestamps.tolist()
    assert all(f.image.dtype == np.uint8 and f.image.ndim == 2 for f in frames)
    assert all(f.image.shape == (sequence.camera.height, sequence.camera.width) for f in frames)
    assert sequence.ground_truth is not None
    assert [image_number(f.image) for f in sequence] == list(range(N)), "iterating again reads again"


def test_dataset_folder(dataset: Path) -> None:
    sequence = open_sequence(dataset)
    assert sequence.name == "walk_01"
    assert sequence.camera == PinholeCamera(fx=30.0, fy=30.0, cx=16.0, cy=12.0, width=32, height=24)
    assert sequence.rate_hz == pytest.approx(10.0)
    assert sequence.frame_timestamps[1] == 100.1
    assert sequence.ground_truth.T_world_cam[:, 0, 3].tolist() == [i + 0.5 for i in range(N)]


def test_a_dataset_folder_without_times_has_those_in_its_names(dataset: Path) -> None:
    (dataset / "groundtruth_tum.txt").unlink()  # of another clock
    (dataset / "times.txt").unlink()
    for i, path in enumerate(sorted((dataset / "images").iterdir())):
        path.rename(path.with_name(f"{1_403_636_579_763_555_584 + 50_000_000 * i}{path.suffix}"))
    sequence = open_sequence(dataset)
    assert sequence.rate_hz == pytest.approx(20.0)
    assert sequence.frame_timestamps[0] == pytest.approx(1_403_636_579.7635555, abs=1e-6)


@pytest.mark.parametrize("numbers", ["0.1 -0.2 0.01 0.02", "0.1 -0.2 0.01 0.02 0.3"])
def test_dataset_folder_with_distortion(dataset: Path, numbers: str) -> None:
    (dataset / "calib.txt").write_text(f"30 30 16 12 {numbers} 32 24\n")
    camera = open_sequence(dataset).camera
    assert isinstance(camera, RadTanCamera)
    assert [camera.k1, camera.k2, camera.p1, camera.p2] == [0.1, -0.2, 0.01, 0.02]
    assert camera.k3 == (0.3 if numbers.endswith("0.3") else 0.0)


def test_a_calibration_for_another_size_is_scaled(dataset: Path, tmp_path: Path, caplog) -> None:
    """The rays of pixels stay: pixel corners are scaled, not their centres. What it was made of is said."""
    path = tmp_path / "camera.yaml"
    path.write_text("model: radtan\nfx: 60\nfy: 62\ncx: 31.5\ncy: 24.5\nk1: -0.1\nwidth: 64\nheight: 48\n")
    camera = open_sequence(dataset, camera_file=path).camera
    assert camera == RadTanCamera(32, 24, 30.0, 31.0, 15.5, 12.0, k1=-0.1)
    assert f"{path} is for images of 64 x 48 pixels: scaled to those of walk_01, 32 x 24" in caplog.text
    for size in ("width: 64\nheight: 40\n", "width: 32\nheight: 25\n"):
        path.write_text(f"model: pinhole\nfx: 30\nfy: 30\ncx: 15\ncy: 12\n{size}")
        with pytest.raises(InputError, match="of another shape; give the calibration of these images"):
            open_sequence(dataset, camera_file=path)


def test_depth_among_colour_is_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """As 7-Scenes has them; a folder of depth alone is what it is."""
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"frame-{i:06d}.color.png"), np.full((24, 32), 100 + i, np.uint8))
        cv2.imwrite(str(tmp_path / f"frame-{i:06d}.depth.png"), np.full((24, 32), 2000, np.uint16))
    frames = list(open_sequence(tmp_path, fov_degrees=60))
    assert [int(f.image[0, 0]) for f in frames] == [100, 101, 102]
    assert "3 images called depth are left out" in caplog.text
    for path in tmp_path.glob("*.color.png"):
        path.unlink()
    assert len(open_sequence(tmp_path, fov_degrees=60)) == 3


@pytest.mark.parametrize(("unit", "per_second"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_times_of_another_unit_are_seconds(dataset: Path, unit: str, per_second: float) -> None:
    """A stated unit; times since 1970, which can be no seconds, without one, with the truth's."""
    wanted_s = open_sequence(dataset).frame_timestamps
    (dataset / "times.txt").write_text("".join(f"{t * per_second:.0f}\n" for t in wanted_s))
    np.testing.assert_allclose(open_sequence(dataset, time_unit=unit).frame_timestamps, wanted_s, atol=1e-3)
    epoch_s = 1.7e9
    (dataset / "times.txt").write_text("".join(f"{(t + epoch_s) * per_second:.0f}\n" for t in wanted_s))
    truth = (dataset / "groundtruth_tum.txt").read_text().splitlines()[1:]
    rows = [line.split(" ", 1) for line in truth]
    (dataset / "groundtruth_tum.txt").write_text(
        "".join(f"{(float(t) + epoch_s) * per_second:.0f} {rest}\n" for t, rest in rows)
    )
    sequence = open_sequence(dataset)
    np.testing.assert_allclose(sequence.frame_timestamps - epoch_s, wanted_s, atol=1e-3)
    np.testing.assert_allclose(sequence.ground_truth.timestamps_s, sequence.frame_timestamps, atol=1e-3)


def test_counts_are_timed_by_the_rate(dataset: Path) -> None:
    (dataset / "times.txt").write_text("0\n1\n2\n3\n4\n5\n")
    sequence = open_sequence(dataset, rate_hz=20.0)
    assert sequence.frame_timestamps.tolist() == [0.0, 0.05, 0.1, 0.15, 0.2, 0.25]
    assert sequence.ground_truth is None, "its clock is another one"
    assert open_sequence(dataset, time_unit="s", camera_file=None).frame_timestamps[5] == 5.0


@pytest.mark.parametrize("stem", ["{ns}", "{us}", "{ms}", "{s}.{us_of_s:06d}", "cam_{ns}"])
def test_images_named_by_their_times(tmp_path: Path, stem: str) -> None:
    """As EuRoC, TUM-VI and TUM RGB-D name them; a number of another size is a number."""
    times_ns = [1_403_636_579_763_555_584 + i * 50_000_000 for i in range(N)]
    for t in times_ns:
        name = stem.format(ns=t, us=t // 1000, ms=t // 10**6, s=t // 10**9, us_of_s=t % 10**9 // 1000) + ".png"
        for folder, its_name in ((tmp_path / "a", name), (tmp_path / "b", name[5:])):
            folder.mkdir(exist_ok=True)
            cv2.imwrite(str(folder / its_name), np.zeros((24, 32), np.uint8))
    sequence = open_sequence(tmp_path / "a", fov_degrees=60)
    assert sequence.rate_hz == pytest.approx(20.0, rel=0.03)
    assert sequence.frame_timestamps[0] == pytest.approx(times_ns[0] * 1e-9, abs=1e-3)
    assert open_sequence(tmp_path / "b", fov_degrees=60).frame_timestamps[0] == 0.0


@pytest.mark.parametrize(("camera", "offset"), [(0, 0.0), (2, 1.0)])
def test_kitti(make, tmp_path: Path, camera: int, offset: float) -> None:
    sequence = open_sequence(make["kitti"](tmp_path, camera))
    assert sequence.name == "kitti_07"
    assert sequence.camera == PinholeCamera(fx=30.0, fy=30.0, cx=16.0, cy=12.0, width=32, height=24)
    truth = sequence.ground_truth
    assert truth.timestamps_s.tolist() == sequence.frame_timestamps.tolist()
    # P2 = K [I | t] with t = -1 m: camera 2 stands 1 m to the right of camera 0, whose poses the file has.
    np.testing.assert_allclose(truth.T_world_cam[:, :3, 3], [[offset, 0, i] for i in range(N)], atol=1e-12)


def test_kitti_without_poses(make, tmp_path: Path) -> None:
    folder = make["kitti"](tmp_path)
    (tmp_path / "poses" / "07.txt").unlink()
    assert open_sequence(folder).ground_truth is None


def test_tum_rgbd(make, tmp_path: Path) -> None:
    sequence = open_sequence(make["tum_rgbd"](tmp_path))
    assert isinstance(sequence.camera, RadTanCamera)
    assert sequence.camera.fx == 520.908620
    assert sequence.frame_timestamps[0] == 100.0
    assert sequence.ground_truth.timestamps_s[0] == 100.003


def test_tum_rgbd_without_a_camera_in_its_name(make, tmp_path: Path) -> None:
    folder = make["tum_rgbd"](tmp_path).rename(tmp_path / "desk")
    with pytest.raises(InputError, match=r"fr1, fr2 or fr3 .* give a camera file"):
        open_sequence(folder)
    assert open_sequence(folder, fov_degrees=60).camera.width == 640


@pytest.mark.parametrize("zipped", [True, False])
def test_tum_mono(make, tmp_path: Path, zipped: bool) -> None:
    sequence = open_sequence(make["tum_mono"](tmp_path / "sequence_01", zipped))
    assert isinstance(sequence.camera, FovCamera)
    np.testing.assert_allclose(sequence.exposure_s, [(2.5 + i) * 1e-3 for i in range(N)])
    assert len(sequence.ground_truth) == N - 1, "the pose that is NaN is left out"
    if zipped:
        assert sorted(p.name for p in (tmp_path / "sequence_01").iterdir()) == [
            "camera.txt",
            "groundtruthSync.txt",
            "images.zip",
            "times.txt",
        ], "read in place"


def test_tum_mono_pinhole(make, tmp_path: Path) -> None:
    folder = make["tum_mono"](tmp_path / "rectified")
    (folder / "camera.txt").write_text("0.5 0.6 0.5 0.5 0\n32 24\nnone\n32 24\n")
    camera = open_sequence(folder).camera
    assert camera == PinholeCamera(fx=16.0, fy=0.6 * 24, cx=15.5, cy=11.5, width=32, height=24)


def test_euroc(make, tmp_path: Path) -> None:
    folder = make["euroc"](tmp_path)
    sequence = open_sequence(folder)
    assert sequence.name == "MH_99_tiny"
    assert isinstance(sequence.camera, RadTanCamera)
    assert sequence.camera.k1 == -0.28
    assert abs(sequence.frame_timestamps[0] - 1403636579.763555584) < 1e-6
    assert sequence.rate_hz == pytest.approx(20.0, rel=1e-5)
    # The camera sits 0.5 m along the body's x, which points along the world's y, and is turned by 90 degrees more.
    T_world_cam = sequence.ground_truth.T_world_cam
    np.testing.assert_allclose(T_world_cam[2, :3, 3], [2.0, 0.5, 0.0], atol=1e-12)
    np.testing.assert_allclose(T_world_cam[2, :3, :3], np.diag([-1.0, -1.0, 1.0]), atol=1e-12)
    assert len(open_sequence(folder / "mav0")) == N


def test_plain_folder_in_natural_order(tmp_path: Path, image_number, caplog: pytest.LogCaptureFixture) -> None:
    for i in range(12):
        cv2.imwrite(str(tmp_path / f"shot{i}.png"), np.full((24, 32), 20 + 10 * i, np.uint8))
    (tmp_path / "notes.txt").write_text("not an image")
    with caplog.at_level(logging.WARNING):
        sequence = open_sequence(tmp_path, fov_degrees=90)
    assert "30 Hz" in caplog.text
    assert [image_number(f.image) for f in sequence] == list(range(12))
    assert sequence.camera.fx == pytest.approx(16.0)
    assert sequence.rate_hz == pytest.approx(30.0)
    assert open_sequence(tmp_path, fov_degrees=90, rate_hz=5).frame_timestamps[1] == 0.2
    own = [0.0, 0.5, *np.arange(1, 11)]
    (tmp_path / "times.txt").write_text("\n".join(map(str, own)))
    assert open_sequence(tmp_path, fov_degrees=90).frame_timestamps.tolist() == own


def test_plain_folder_whose_times_and_calibration_stand_among_the_images(dataset: Path, tmp_path: Path) -> None:
    for file in (dataset / "calib.txt", dataset / "times.txt"):
        shutil.copy(file, dataset / "images")
    loose = open_sequence(dataset / "images")
    whole = open_sequence(dataset)
    assert loose.camera == whole.camera
    assert loose.frame_timestamps.tolist() == whole.frame_timestamps.tolist()
    assert open_sequence(dataset / "images", fov_degrees=90).camera.fx == pytest.approx(16.0)
    assert open_sequence(dataset / "images", rate_hz=2.0).frame_timestamps[5] == 2.5
    (dataset / "images" / "times.txt").write_text("1\n2\n")
    with pytest.raises(InputError, match=r"times.txt has 2 times, but .* has 6 images"):
        open_sequence(dataset / "images")


def test_plain_folder_with_a_camera_file(dataset: Path, tmp_path: Path) -> None:
    camera = {"model": "pinhole", "fx": 30, "fy": 30, "cx": 16, "cy": 12, "width": 32, "height": 24}
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(camera))
    assert open_sequence(dataset / "images", camera_file=file).camera.fx == 30


def test_a_given_camera_goes_before_the_source_s_own(dataset: Path, tmp_path: Path) -> None:
    file = tmp_path / "calib.txt"
    file.write_text("50 50 16 12 32 24\n")
    assert open_sequence(dataset, camera_file=file).camera.fx == 50
    (dataset / "calib.txt").unlink()
    assert open_sequence(dataset, camera_file=file).camera.fx == 50
    assert open_sequence(dataset, fov_degrees=90).camera.fx == pytest.approx(16.0)


def test_colour_is_rgb(dataset: Path) -> None:
    red = np.zeros((24, 32, 3), np.uint8)
    red[..., 2] = 255  # OpenCV writes BGR
    cv2.imwrite(str(dataset / "images" / "000000.png"), red)
    first, second = list(open_sequence(dataset, grey=False, max_frames=2))
    assert first.image.shape == (24, 32, 3)
    assert first.image[0, 0].tolist() == [255, 0, 0]
    assert second.image[0, 0].tolist() == [30, 30, 30]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"start": 2}, [2, 3, 4, 5]),
        ({"stride": 2}, [0, 2, 4]),
        ({"start": 1, "stride": 2, "max_frames": 2}, [1, 3]),
        ({"max_frames": 100}, [0, 1, 2, 3, 4, 5]),
        ({"reverse": True}, [5, 4, 3, 2, 1, 0]),
        ({"start": 1, "stride": 2, "max_frames": 2, "reverse": True}, [3, 1]),
    ],
)
def test_selection_keeps_source_index_and_true_time(dataset: Path, image_number, options, expected) -> None:
    sequence = open_sequence(dataset, **options)
    frames = list(sequence)
    assert [f.index for f in frames] == sequence.source_indices.tolist() == expected
    assert [image_number(f.image) for f in frames] == expected
    np.testing.assert_allclose([f.timestamp_s for f in frames], [100 + 0.1 * i for i in expected])
    assert len(sequence) == len(expected)
    assert sequence.rate_hz == pytest.approx(10.0 / options.get("stride", 1))
    assert len(sequence.source_timestamps) == N
