"""Camera files of our own and of other tools."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from dualslam.core.camera.models import FovCamera, KannalaBrandtCamera, PinholeCamera, RadTanCamera
from dualslam.core.errors import InputError
from dualslam.io import read_camera_file

PINHOLE = PinholeCamera(width=640, height=480, fx=500.0, fy=501.0, cx=320.0, cy=240.0)
RADTAN = RadTanCamera(640, 480, 500.0, 501.0, 320.0, 240.0, k1=-0.1, k2=0.02, p1=0.001, p2=-0.002, k3=0.003)
FISHEYE = KannalaBrandtCamera(640, 480, 300.0, 301.0, 320.0, 240.0, k1=0.01, k2=-0.002, k3=0.0003, k4=-0.0001)
FOV = FovCamera(640, 480, 300.0, 301.0, 320.0, 240.0, omega=0.9)

ORB_SLAM = "".join(
    f"Camera.{name}: {value}\n"
    for name, value in {"fx": 500, "fy": 501, "cx": 320, "cy": 240, "width": 640, "height": 480}.items()
)


@pytest.mark.parametrize("camera", [PINHOLE, RADTAN, FISHEYE, FOV], ids=lambda c: c.model)
@pytest.mark.parametrize("suffix", [".yaml", ".yml", ".json"])
def test_our_own_format(tmp_path: Path, camera, suffix: str) -> None:
    path = tmp_path / f"camera{suffix}"
    values = camera.to_dict()
    path.write_text(json.dumps(values) if suffix == ".json" else yaml.safe_dump(values))
    assert read_camera_file(path) == camera


@pytest.mark.parametrize("n", [0, 4, 5])
def test_opencv_file_storage(tmp_path: Path, n: int) -> None:
    path = tmp_path / "opencv.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", PINHOLE.K)
    if n:
        storage.write("distortion_coefficients", np.array([[-0.1, 0.02, 0.001, -0.002, 0.003][:n]]))
    storage.release()
    assert "!!opencv-matrix" in path.read_text()
    camera = read_camera_file(path)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500.0, 501.0, 320.0, 240.0)
    assert isinstance(camera, RadTanCamera if n else PinholeCamera)
    if n == 5:
        assert camera == RADTAN


@pytest.mark.parametrize(
    ("model", "distortion", "expected"),
    [
        ("plumb_bob", "[-0.1, 0.02, 0.001, -0.002, 0.003]", RADTAN),
        ("equidistant", "[0.01, -0.002, 0.0003, -0.0001]", None),
    ],
)
def test_ros_camera_info(tmp_path: Path, model: str, distortion: str, expected) -> None:
    path = tmp_path / "camera_info.yaml"
    path.write_text(
        "image_width: 640\nimage_height: 480\ncamera_name: left\n"
        "camera_matrix:\n  rows: 3\n  cols: 3\n  data: [500.0, 0, 320.0, 0, 501.0, 240.0, 0, 0, 1]\n"
        f"distortion_model: {model}\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data: {distortion}\n"
    )
    camera = read_camera_file(path)
    if expected is None:
        assert isinstance(camera, KannalaBrandtCamera)
        assert camera.k4 == -0.0001
    else:
        assert camera == expected


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"model": "pinhole", "fx": 500, "fx": 700}', r"camera.json: the key 'fx' stands there twice; correct it"),
        ("model: pinhole\nfx: 500\nfx: 700\n", "line 3 is not valid YAML: the key 'fx' stands there twice; correct it"),
        (f"{ORB_SLAM}Camera.k1: none\n", "k1 is 'none', not a number"),
        (f"{ORB_SLAM}Camera.p2: .nan\n", "p2 holds a number that is not finite"),
    ],
)
def test_a_slip_is_named(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / ("camera.json" if text.startswith("{") else "camera.yaml")
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_camera_file(path)


def test_a_camera_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    matrix = "image_width: 640\nimage_height: 480\ncamera_matrix: {data: [500, 0, 320, 0, 501, 240, 0, 0, 1]}\n"
    path.write_text(f"{matrix}distortion_model: scaramuzza\n")
    with pytest.raises(InputError, match="'scaramuzza' is not one of those that are read: pinhole"):
        read_camera_file(path)
    path.write_text(
        "Camera.type: equirectangular\nCamera.fx: 5\nCamera.fy: 5\nCamera.cx: 9\nCamera.cy: 9\n"
        "Camera.width: 20\nCamera.height: 20\n"
    )
    with pytest.raises(InputError, match="'equirectangular'"):
        read_camera_file(path)


def test_orb_slam_settings(tmp_path: Path) -> None:
    path = tmp_path / "TUM1.yaml"
    path.write_text(
        '%YAML:1.0\n\nCamera.type: "PinHole"\nCamera.fx: 500.0\nCamera.fy: 501.0\nCamera.cx: 320.0\nCamera.cy: 240.0\n'
        "Camera.k1: -0.1\nCamera.k2: 0.02\nCamera.p1: 0.001\nCamera.p2: -0.002\nCamera.k3: 0.003\n"
        "Camera.width: 640\nCamera.height: 480\nCamera.fps: 30.0\nORBextractor.nFeatures: 1000\n"
    )
    assert read_camera_file(path) == RADTAN


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ("500 501 320 240 640 480\n", PINHOLE),
        ("# a comment\n500 501 320 240 -0.1 0.02 0.001 -0.002 0.003 640 480\n", RADTAN),
        ("500 501 320 240 0 0 0 0 640 480\n", PINHOLE),
        ("300 301 320 240 0.9\n640 480\ncrop\n640 480\n", FOV),
        ("500 501 320 240 0\n640 480\nnone\n640 480\n", PINHOLE),
        ("Pinhole 500 501 320 240 0\n640 480\nnone\n640 480\n", PINHOLE),
        ("RadTan 500 501 320 240 0 0 0 0\n640 480\nnone\n640 480\n", PINHOLE),
        ("KannalaBrandt 300 301 320 240 0.01 -0.002 0.0003 -0.0001\n640 480\nnone\n640 480\n", FISHEYE),
        ("Pinhole 0.5 0.5 0.5 0.5 0\n640 480\nnone\n640 480\n", PinholeCamera(640, 480, 320.0, 240.0, 319.5, 239.5)),
    ],
)
def test_text_files(tmp_path: Path, lines: str, expected) -> None:
    path = tmp_path / "calib.txt"
    path.write_text(lines)
    assert read_camera_file(path) == expected


def test_the_fov_model_of_tum_mono_is_relative_to_the_image(tmp_path: Path) -> None:
    path = tmp_path / "camera.txt"
    path.write_text("0.349153 0.436593 0.493140 0.499021 0.933271\n1280 1024\n0.4 0.53 0.5 0.5 0\n640 480\n")
    camera = read_camera_file(path)
    assert isinstance(camera, FovCamera)
    assert (camera.width, camera.height, camera.omega) == (1280, 1024, 0.933271)
    np.testing.assert_allclose([camera.fx, camera.fy], [0.349153 * 1280, 0.436593 * 1024])
    np.testing.assert_allclose([camera.cx, camera.cy], [0.493140 * 1280 - 0.5, 0.499021 * 1024 - 0.5])


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("c.yaml", "fx: 1\n", "add `model: pinhole`"),
        ("c.yaml", "model: pinhole\nfx: 500\n", "'width' is missing"),
        ("c.yaml", "model: pinhole\nfx: .nan\nfy: 5\ncx: 3\ncy: 3\nwidth: 8\nheight: 8\n", "fx is nan"),
        ("c.yaml", "- 1\n- 2\n", "is not a camera file"),
        ("c.yaml", "a: [", "not valid YAML"),
        ("c.json", "{", "line 1 is not valid JSON"),
        ("c.json", "[1]", "is not a camera file"),
        (
            "c.yaml",
            "camera_matrix: [1, 2, 3]\nimage_width: 4\nimage_height: 4\n",
            "camera_matrix has 3 numbers; it should be fx fy cx cy",
        ),
        ("c.yaml", "camera_matrix: [5, 0, 2, 0, 5, 2, 0, 0, 1]\n", "add image_width"),
        ("c.yaml", "camera_matrix: [5, 0, .inf, 0, 5, 2, 0, 0, 1]\nimage_width: 4\nimage_height: 4\n", "not finite"),
        ("c.yaml", "camera_matrix: hello\nimage_width: 4\nimage_height: 4\n", "camera_matrix is not a list"),
        ("c.yaml", "Camera.fx: 500\nCamera.fy: 500\nCamera.cx: x\n", "cx is 'x', not a number"),
        ("c.yaml", "Camera.fx: 500\nCamera.fy: 500\n", "has no cx"),
        ("c.txt", "1 2 3\n", "has 3 numbers"),
        ("c.txt", "Wide 1 2 3 4 5\n640 480\n", "no known camera"),
        ("c.txt", "", "has 0 lines"),
    ],
)
def test_bad_camera_files(tmp_path: Path, name: str, content: str, words: str) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(InputError) as caught:
        read_camera_file(path)
    message = str(caught.value)
    assert words in message
    assert str(path) in message
    assert message.endswith(".")
    assert "\n" not in message


def test_more_distortion_than_we_know(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    head = "image_width: 640\nimage_height: 480\ncamera_matrix: [500, 0, 320, 0, 501, 240, 0, 0, 1]\n"
    path.write_text(head + "distortion_coefficients: [0.1, 0.1, 0, 0, 0, 0.3, 0, 0]\n")
    with pytest.raises(InputError, match="8 distortion coefficients"):
        read_camera_file(path)
    path.write_text(head + "distortion_coefficients: [-0.1, 0.02, 0.001, -0.002, 0.003, 0, 0, 0]\n")
    assert read_camera_file(path) == RADTAN


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("calib.txt", "481.2 -480 319.5 239.5 -0.2 0.05 0.001 0.002 640 480\n"),
        (
            "c.yaml",
            "model: radtan\nfx: 481.2\nfy: -480\ncx: 319.5\ncy: 239.5\nk1: -0.2\nk2: 0.05\np1: 0.001\np2: 0.002\n"
            "width: 640\nheight: 480\n",
        ),
    ],
)
def test_a_y_axis_that_points_up_is_turned_down(tmp_path: Path, name: str, text: str) -> None:
    """What the calibration's own camera frame, y up, projects to a pixel, ours projects there with y down."""
    (tmp_path / name).write_text(text)
    camera = read_camera_file(tmp_path / name)
    k1, k2, p1, p2 = -0.2, 0.05, 0.001, 0.002
    x, y = np.random.default_rng(0).uniform(-0.4, 0.4, (2, 20))
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    u = 481.2 * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + 319.5
    v = -480 * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + 239.5
    ours = camera.project(np.column_stack([x, -y, np.ones(20)]))
    np.testing.assert_allclose(ours, np.column_stack([u, v]), atol=1e-9)


@pytest.mark.parametrize("content", ["name: left\n", "fx: 500\nfy: 500\ncx: 320\ncy: 240\nwidth: 640\nheight: 480\n"])
def test_a_file_that_does_not_say_which_camera_it_is(tmp_path: Path, content: str) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(content)
    with pytest.raises(InputError, match=r"camera\.yaml does not say which camera it is: add `model: pinhole` \(or"):
        read_camera_file(path)


def test_a_model_without_its_numbers(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text("camera_model: omni\n")
    with pytest.raises(InputError, match=r"camera\.yaml has no intrinsics; add fx, fy, cx and cy"):
        read_camera_file(path)
