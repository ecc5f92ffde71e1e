"""Tiny datasets of every layout, written into a temporary folder."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

WIDTH, HEIGHT = 32, 24
N = 6


def image_of(i: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """An image that tells which one it is by its grey level."""
    return np.full((height, width), 20 + 10 * i, np.uint8)


def number_of(image: np.ndarray) -> int:
    """The number of an `image_of`."""
    return round((float(np.mean(image)) - 20) / 10)


def write_images(folder: Path, names: list[str], width: int = WIDTH, height: int = HEIGHT) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        assert cv2.imwrite(str(folder / name), image_of(i, width, height))


def tum_lines(times: list[float]) -> str:
    return "# comment\n" + "".join(f"{t:.6f} {i}.5 0 0 0 0 0 1\n" for i, t in enumerate(times))


TIMES = [100.0 + 0.1 * i for i in range(N)]


def make_dataset(folder: Path) -> Path:
    write_images(folder / "images", [f"{i:06d}.png" for i in range(N)])
    (folder / "times.txt").write_text("".join(f"{t:.6f}\n" for t in TIMES))
    (folder / "calib.txt").write_text(f"# fx fy cx cy width height\n30 30 16 12 {WIDTH} {HEIGHT}\n")
    (folder / "groundtruth_tum.txt").write_text(tum_lines(TIMES))
    return folder


def make_kitti(root: Path, camera: int = 0) -> Path:
    folder = root / "sequences" / "07"
    write_images(folder / f"image_{camera}", [f"{i:06d}.png" for i in range(N)])
    (folder / "times.txt").write_text("".join(f"{0.1 * i:.6e}\n" for i in range(N)))
    lines = [f"P{c}: 30 0 16 {-15.0 * c} 0 30 12 0 0 0 1 0\n" for c in range(4)]
    (folder / "calib.txt").write_text("".join(lines) + "Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    (root / "poses").mkdir()
    (root / "poses" / "07.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {i}\n" for i in range(N)))
    return folder


def make_tum_rgbd(root: Path) -> Path:
    folder = root / "rgbd_dataset_freiburg2_desk"
    (folder / "rgb").mkdir(parents=True)
    listing = ["# color images", "# timestamp filename"]
    for i, t in enumerate(TIMES):
        name = f"rgb/{t:.6f}.png"
        cv2.imwrite(str(folder / name), image_of(i, 640, 480))
        listing.append(f"{t:.6f} {name}")
    (folder / "rgb.txt").write_text("\n".join(listing) + "\n")
    (folder / "groundtruth.txt").write_text(tum_lines([t + 0.003 for t in TIMES]))
    return folder


def make_tum_mono(folder: Path, zipped: bool = True) -> Path:
    names = [f"{i:05d}.jpg" for i in range(N)]
    write_images(folder / "images", names)
    if zipped:
        with zipfile.ZipFile(folder / "images.zip", "w") as archive:
            for name in names:
                archive.write(folder / "images" / name, f"images/{name}")
                (folder / "images" / name).unlink()
            archive.writestr("__MACOSX/images/._00000.jpg", b"shadow")
        (folder / "images").rmdir()
    (folder / "camera.txt").write_text(f"0.5 0.6 0.5 0.5 0.9\n{WIDTH} {HEIGHT}\ncrop\n640 480\n")
    (folder / "times.txt").write_text("".join(f"{i:05d} {t:.9f} {2.5 + i}\n" for i, t in enumerate(TIMES)))
    truth = tum_lines(TIMES).splitlines()
    truth[3] = f"{TIMES[2]} NaN NaN NaN NaN NaN NaN NaN"
    (folder / "groundtruthSync.txt").write_text("\n".join(truth) + "\n")
    return folder


def make_euroc(root: Path) -> Path:
    folder = root / "MH_99_tiny"
    cam = folder / "mav0" / "cam0"
    nanoseconds = [1403636579763555584 + 50_000_000 * i for i in range(N)]
    write_images(cam / "data", [f"{t}.png" for t in nanoseconds])
    rows = "".join(f"{t},{t}.png\r\n" for t in nanoseconds)
    (cam / "data.csv").write_text("#timestamp [ns],filename\r\n" + rows)
    (cam / "sensor.yaml").write_text(
        "# General sensor definitions.\nsensor_type: camera\ncomment: VI-Sensor cam0 (MT9M034)\n"
        "T_BS:\n  cols: 4\n  rows: 4\n  data: [0, -1, 0, 0.5,\n         1, 0, 0, 0.0,\n         0, 0, 1, 0.0,\n"
        "         0.0, 0.0, 0.0, 1.0]\nrate_hz: 20\n"
        f"resolution: [{WIDTH}, {HEIGHT}]\ncamera_model: pinhole\nintrinsics: [30.0, 31.0, 16.0, 12.0]\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]\n"
    )
    truth = folder / "mav0" / "state_groundtruth_estimate0"
    truth.mkdir()
    rest = ",0" * 9
    # The body stands turned by 90 degrees about z, and moves along x.
    half = np.sqrt(0.5)
    (truth / "data.csv").write_text(
        "#timestamp, p_RS_R_x [m], ...\n"
        + "".join(f"{t},{i}.0,0,0,{half},0,0,{half}{rest}\n" for i, t in enumerate(nanoseconds))
    )
    return folder


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    return make_dataset(tmp_path / "walk_01")


@pytest.fixture
def make() -> dict[str, Callable[..., Path]]:
    """The makers of all folder layouts by name."""
    return {
        "dataset": make_dataset,
        "kitti": make_kitti,
        "tum_rgbd": make_tum_rgbd,
        "tum_mono": make_tum_mono,
        "euroc": make_euroc,
    }


@pytest.fixture
def image_number() -> Callable[[np.ndarray], int]:
    return number_of
