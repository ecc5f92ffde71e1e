"""What is wrong with an input is said in one sentence that names the file; one bad image stops nothing."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from dualslam.core.errors import InputError
from dualslam.io import open_sequence


def raises_sentence(source: Path | str | int, *parts: str, **options: object) -> None:
    with pytest.raises(InputError) as caught:
        open_sequence(source, **options)  # type: ignore[arg-type]
    message = str(caught.value)
    for part in parts:
        assert part in message
    assert "\n" not in message
    assert message.endswith(".")


# --- one bad image


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda p: p.write_bytes(b""), "is empty"),
        (lambda p: p.write_bytes(b"this is no image"), "cannot be decoded"),
        (lambda p: p.write_bytes(p.read_bytes()[:-20]), "cut off"),
        (lambda p: p.unlink(), "does not exist"),
        (lambda p: cv2.imwrite(str(p), np.zeros((10, 20), np.uint8)), "20 x 10"),
    ],
    ids=["empty", "garbage", "truncated", "missing", "other size"],
)
@pytest.mark.parametrize("which", [0, 3])
def test_a_bad_image_is_an_unreadable_frame(dataset: Path, damage: Callable[[Path], object], words: str, which: int):
    sequence = open_sequence(dataset)
    damage(dataset / "images" / f"{which:06d}.png")
    if words != "does not exist":
        sequence = open_sequence(dataset)
    frames = list(sequence)
    assert [f.index for f in frames] == list(range(6))
    assert [f.image is None for f in frames] == [i == which for i in range(6)]
    assert words in frames[which].error
    assert str(which) in frames[which].error
    assert frames[which].error.endswith(".")
    assert "\n" not in frames[which].error
    assert frames[which].timestamp_s == pytest.approx(100 + 0.1 * which)


def test_images_of_mixed_sizes_are_told_once_and_counted(dataset: Path, caplog: pytest.LogCaptureFixture) -> None:
    for i in (1, 3, 4):
        cv2.imwrite(str(dataset / "images" / f"{i:06d}.png"), np.zeros((10, 20), np.uint8))
    frames = list(open_sequence(dataset))
    assert [f.index for f in frames if "20 x 10" in f.error] == [1, 3, 4]
    first, count = (record.getMessage() for record in caplog.records if record.levelname == "WARNING")
    assert first == "frame 1: image 1 of walk_01 is 20 x 10 pixels, the camera 32 x 24."
    assert count == "walk_01: 3 of the 6 images that were read are unusable"


def test_an_image_that_was_lost_from_numbered_files_keeps_its_place(dataset: Path, image_number) -> None:
    (dataset / "images" / "000002.png").unlink()
    frames = list(open_sequence(dataset))
    assert "000002.png does not exist" in frames[2].error
    assert image_number(frames[3].image) == 3


@pytest.mark.parametrize("missing", [0, 5])
def test_a_lost_first_or_last_image_is_not_guessed(dataset: Path, missing: int) -> None:
    (dataset / "images" / f"{missing:06d}.png").unlink()
    raises_sentence(dataset, "times.txt has 6 times", "has 5 images")


def test_truncated_jpeg_in_a_zip(make, tmp_path: Path) -> None:
    folder = make["tum_mono"](tmp_path / "mono")
    with zipfile.ZipFile(folder / "images.zip") as archive:
        content = {n: archive.read(n) for n in archive.namelist()}
    with zipfile.ZipFile(folder / "images.zip", "w") as archive:
        for name, data in content.items():
            archive.writestr(name, data[: len(data) // 2] if name.endswith("00004.jpg") else data)
    frames = list(open_sequence(folder))
    assert [f.index for f in frames if f.image is None] == [4]
    assert "00004.jpg in " in frames[4].error


def test_what_follows_the_image_in_its_file_does_no_harm(dataset: Path) -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (400, 400), np.uint8)
    path = dataset / "images" / "000000.jpg"
    cv2.imwrite(str(path), image)
    (dataset / "images" / "000000.png").unlink()
    whole = path.read_bytes()
    assert len(whole) > 1 << 16
    film = bytes(5000)
    for data, readable in ((whole + film, True), (whole[: 1 << 16], False)):
        path.write_bytes(data)
        frame = next(iter(open_sequence(dataset / "images", fov_degrees=60, max_frames=1)))
        # Either way it is not of the size of the others.
        assert frame.image is None
        assert ("400 x 400" if readable else "cut off") in frame.error


def test_no_image_at_all_can_be_read(dataset: Path) -> None:
    for image in (dataset / "images").iterdir():
        image.write_bytes(b"junk")
    raises_sentence(dataset, "none of its 6 images can be read, as", "000000.png cannot be decoded")


# --- folders and files


def test_nothing_there(tmp_path: Path) -> None:
    raises_sentence(tmp_path / "nowhere", "nowhere does not exist", "give a sequence folder")
    raises_sentence(tmp_path, "no sequence that can be read", "check the path")
    (tmp_path / "IMG_0001.HEIC").touch()
    raises_sentence(tmp_path, "holds .heic files, which are not read", "convert them to PNG or JPEG")
    (tmp_path / "images").mkdir()
    raises_sentence(tmp_path, "holds no images", fov_degrees=90)
    (tmp_path / "notes.md").write_text("hello")
    raises_sentence(tmp_path / "notes.md", "no video that OpenCV can open")


def test_missing_parts(dataset: Path) -> None:
    (dataset / "calib.txt").rename(dataset / "calib.bak")
    raises_sentence(dataset, "walk_01 has no calibration", "give a camera file, or a field of view")
    raises_sentence(dataset / "images", "images has no calibration", "give a camera file, or a field of view")


@pytest.mark.parametrize("layout", ["kitti", "tum_mono"])
def test_missing_parts_of_known_layouts(make, tmp_path: Path, layout: str) -> None:
    folder = make[layout](tmp_path / "d")
    calibration = {"kitti": "calib.txt", "tum_mono": "camera.txt"}[layout]
    times = (folder / "times.txt").read_text()
    (folder / "times.txt").unlink()
    raises_sentence(folder, "times.txt does not exist", "give the rate of the frames (--rate HZ)")
    assert open_sequence(folder, rate_hz=20.0).rate_hz == pytest.approx(20.0)
    (folder / "times.txt").write_text("\n".join(times.splitlines()[:-1]))
    raises_sentence(folder, "times.txt has 5 times", "6 images", "one time for each image")
    (folder / "times.txt").write_text(times)
    (folder / calibration).unlink()
    raises_sentence(folder, f"{calibration} does not exist")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("100\n101\nnan\n103\n104\n105\n", ["time 3 is nan"]),
        ("100\n101\ninf\n103\n104\n105\n", ["time 3 is inf"]),
        ("100\n101\n101\n103\n104\n105\n", ["time 3 (101.000000) is not later", "must increase"]),
        ("100\n101\n99\n103\n104\n105\n", ["time 3 (99.000000) is not later"]),
        ("100\n101\n", ["has 2 times", "6 images"]),
        ("100\n101\nhello\n103\n104\n105\n", ["line 3", "'hello'"]),
        ("1e18\n2e18\n3e18\n4e18\n5e18\n6e18\n", ["1e+09 apart: 1e-09 Hz", "give the rate of the frames"]),
        (
            "0\n33\n67\n100\n133\n167\n",
            ["33 apart: 0.0303 Hz as seconds, but 30.3 Hz as milliseconds", "--time-unit ms"],
        ),
        ("0\n5e4\n1e5\n15e4\n2e5\n25e4\n", ["but 20 Hz as microseconds", "--time-unit us"]),
        ("7\n5e7\n1e8\n15e7\n2e8\n25e7\n", ["but 20 Hz as nanoseconds", "--time-unit ns"]),
        ("0\n1\n2\n3\n4\n5\n", ["its times count frames (0, 1, ...)", "--rate HZ", "--time-unit s)"]),
        ("0\n2\n4\n6\n8\n10\n", ["its times count frames (0, 2, ...)", "--rate HZ", "--time-unit s)"]),
        ("0\n5\n10\n15\n20\n25\n", ["0.2 Hz as seconds, but 200 Hz as milliseconds", "or s if they are seconds"]),
        ("0\n1e-5\n2e-5\n3e-5\n4e-5\n5e-5\n", ["1e+05 Hz as seconds; give", "--time-unit s if they are seconds"]),
        ("1 2\n3 4\n", ["line 1", "2 numbers where 1"]),
        ("", ["is empty"]),
    ],
)
def test_bad_times(dataset: Path, content: str, words: list[str]) -> None:
    (dataset / "times.txt").write_text(content)
    raises_sentence(dataset, "times.txt", *words)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("30 30 16 12 32\n", ["has 5 numbers", "fx fy cx cy"]),
        ("30 nan 16 12 32 24\n", ["not finite"]),
        ("30 x 16 12 32 24\n", ["not a line of numbers"]),
        ("-30 30 16 12 32 24\n", ["fx"]),
        ("30 30 16 12 32.5 24\n", ["32.5", "whole numbers"]),
        ("30 30 16 12 64 40\n", ["64 x 40", "32 x 24", "of another shape", "give the calibration of these images"]),
    ],
)
def test_bad_calibration(dataset: Path, content: str, words: list[str]) -> None:
    (dataset / "calib.txt").write_text(content)
    raises_sentence(dataset, "calib.txt", *words)


def test_bad_kitti(make, tmp_path: Path) -> None:
    folder = make["kitti"](tmp_path)
    poses = tmp_path / "poses" / "07.txt"
    poses.write_text("".join(poses.read_text().splitlines(keepends=True)[:-1]))
    raises_sentence(folder, "07.txt has 5 poses for 6 frames")
    (folder / "calib.txt").write_text("P0: 1 2 3\n")
    raises_sentence(folder, "calib.txt: P0 should be 12")
    (folder / "calib.txt").write_text("P1: 1 2 3\n")
    raises_sentence(folder, "calib.txt has no line `P0:`")


def test_bad_tum_rgbd(make, tmp_path: Path) -> None:
    folder = make["tum_rgbd"](tmp_path)
    listing = folder / "rgb.txt"
    content = listing.read_text()
    listing.write_text(content + "one two three\n")
    raises_sentence(folder, "rgb.txt, line 9", "timestamp filename")
    listing.write_text("# nothing\n")
    raises_sentence(folder, "rgb.txt lists no images")
    lines = content.splitlines()
    listing.write_text("\n".join([*lines[:2], lines[3], lines[2]]) + "\n")
    raises_sentence(folder, "rgb.txt: time 2", "not later")


def test_a_piece_of_tum_mono_that_motion_capture_did_not_see_has_no_truth(
    make, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = make["tum_mono"](tmp_path / "mono")
    (folder / "groundtruthSync.txt").write_text("".join(f"{i} {' '.join(['NaN'] * 7)}\n" for i in range(6)))
    assert open_sequence(folder).ground_truth is None
    assert "groundtruthSync.txt knows the pose of no frame" in caplog.text


def test_bad_tum_mono(make, tmp_path: Path) -> None:
    folder = make["tum_mono"](tmp_path / "mono")
    (folder / "camera.txt").write_text("0.5 0.6\n32 24\n")
    raises_sentence(folder, "camera.txt", "fx fy cx cy omega")
    (folder / "camera.txt").write_text("0.5 0.6 0.5 0.5 nan\n32 24\n")
    raises_sentence(folder, "camera.txt", "not finite")
    (folder / "times.txt").write_text("0 0.0 1\n1 0.1\n")
    raises_sentence(folder, "times.txt: entry 2 has 2 fields")
    (folder / "images.zip").write_bytes(b"not a zip")
    raises_sentence(folder, "images.zip cannot be read as a zip archive")


def test_bad_euroc(make, tmp_path: Path) -> None:
    folder = make["euroc"](tmp_path)
    sensor = folder / "mav0" / "cam0" / "sensor.yaml"
    content = sensor.read_text()
    sensor.write_text(content.replace("intrinsics", "something"))
    raises_sentence(folder, "sensor.yaml has no intrinsics")
    sensor.write_text(content.replace("1.0]", "]"))
    raises_sentence(folder, "sensor.yaml: T_BS is not a matrix of 4 x 4")
    sensor.write_text(content.replace("30.0", ".nan"))
    raises_sentence(folder, "sensor.yaml")
    sensor.write_text(content.replace("radial-tangential", "unified"))
    raises_sentence(
        folder, "sensor.yaml: distortion_model: the camera model 'unified' is not one of those", "radial-tangential"
    )
    sensor.write_text(content.replace("pinhole", "omni"))
    raises_sentence(folder, "sensor.yaml: intrinsics has 4 numbers; it should be xi fx fy cx cy")
    sensor.write_text("a: [1, 2\nb: {")
    raises_sentence(folder, "sensor.yaml, line", "not valid YAML")
    sensor.unlink()
    raises_sentence(folder, "sensor.yaml does not exist", "give a camera file")
    assert open_sequence(folder, fov_degrees=80).ground_truth is None


def test_bad_ground_truth(dataset: Path) -> None:
    (dataset / "groundtruth_tum.txt").write_text("100 0 0 0 0 0 0 1\n100.1 0 0 0 0 0 0\n")
    raises_sentence(dataset, "groundtruth_tum.txt, line 2", "7 numbers where 8")
    (dataset / "groundtruth_tum.txt").write_text("100 0 0 0 0 0 0 0\n")
    raises_sentence(dataset, "groundtruth_tum.txt", "quaternion of pose 1")
    (dataset / "groundtruth_tum.txt").write_text("1600000100 0 0 0 0 0 0 1\n")
    raises_sentence(dataset, "frames begin at 100.0 s and its ground truth at 1600000100.0 s", "different clocks")


# --- options


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"start": 6}, ["start is 6", "6 frames"]),
        ({"start": -1}, ["start is -1"]),
        ({"stride": 0}, ["stride is 0"]),
        ({"stride": -1}, ["use reverse"]),
        ({"max_frames": 0}, ["max_frames is 0"]),
        ({"fov_degrees": 200.0}, ["field of view"]),
        ({"fov_degrees": 90.0, "camera_file": "c.yaml"}, ["both given"]),
        ({"camera_file": "nowhere.yaml"}, ["nowhere.yaml does not exist"]),
        ({"rate_hz": 0.0}, ["frame rate"]),
    ],
)
def test_bad_options(dataset: Path, options: dict[str, object], words: list[str]) -> None:
    raises_sentence(dataset, *words, **options)


def test_a_pipe_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    raises_sentence(tmp_path / "pipe", "pipe is neither a file nor a folder")
