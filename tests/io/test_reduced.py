"""Large images are read smaller, and their camera with them."""

from __future__ import annotations

import logging
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from dualslam.core.camera.models import PinholeCamera, camera_from_fov
from dualslam.core.types import Frame
from dualslam.io import open_sequence
from dualslam.io.reduced import MAX_SIDE_PX, reduced_camera, reduction, resized_frames

CALIB = "50 52 20.5 14.5 43 31\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three images of 43 x 31 pixels whose grey level is the column."""
    (tmp_path / "images").mkdir()
    image = np.tile(np.arange(43, dtype=np.uint8), (31, 1))
    for i in range(3):
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), image)
    (tmp_path / "times.txt").write_text("0\n0.1\n0.2\n")
    (tmp_path / "calib.txt").write_text(CALIB)
    return tmp_path


@pytest.mark.parametrize(
    ("width", "height", "factor"),
    [(640, 480, 1), (2048, 1536, 1), (2704, 1520, 2), (2160, 3840, 2), (3840, 2160, 2), (5999, 4000, 3), (8192, 4, 4)],
)
def test_images_are_reduced_no_further_than_they_must(width: int, height: int, factor: int) -> None:
    camera = PinholeCamera(width=width, height=height, fx=width, fy=width, cx=0.0, cy=0.0)
    assert reduction(camera, MAX_SIDE_PX) == factor
    small = reduced_camera(camera, factor)
    # Whoever names the size of the small ones gets the same again: an export, of a run's images.
    assert reduction(camera, max(small.width, small.height)) == factor
    assert reduction(camera, None) == 1


def test_a_point_falls_on_the_pixel_that_covers_it() -> None:
    camera = PinholeCamera(width=43, height=31, fx=50.0, fy=52.0, cx=20.5, cy=14.5)
    point = np.array([[0.1, -0.05, 1.0]])
    large, small = camera.project(point), reduced_camera(camera, 3).project(point)
    np.testing.assert_allclose(small + 0.5, (large + 0.5) / 3)


def test_a_sequence_of_large_images_is_read_smaller_and_says_so(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        sequence = open_sequence(folder, max_side_px=21)
    assert (sequence.camera.width, sequence.camera.height) == (21, 15)
    assert sequence.camera.fx == 25.0
    assert "43 x 31 pixels are read as 21 x 15" in caplog.text
    frames = list(sequence)
    assert [frame.error for frame in frames] == ["", "", ""]
    image = frames[0].image
    assert image is not None
    np.testing.assert_allclose(image[0], np.arange(21) * 2 + 0.5, atol=0.51)


def test_an_image_that_reducing_leaves_nothing_of_is_unreadable(folder: Path) -> None:
    cv2.imwrite(str(folder / "images" / "1.png"), np.zeros((31, 1), np.uint8))
    frames = list(open_sequence(folder, max_side_px=21))
    assert [frame.image is None for frame in frames] == [False, True, False]
    assert "image 1 is 1 x 31 pixels" in frames[1].error


def test_small_images_and_those_that_are_wanted_whole_stay_as_they_are(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for sequence in (open_sequence(folder), open_sequence(folder, max_side_px=None)):
        assert sequence.camera.width == 43
    assert not caplog.text


def test_frames_resized_show_the_same_rays(tmp_path: Path) -> None:
    """Whole images, with a camera whose pixels look where theirs did; what is unreadable stays so."""
    image = np.zeros((24, 32), np.uint8)
    image[8:16, 8:16] = 200
    frames = [Frame(0, 0.0, image), Frame(1, 0.1, None, "torn")]
    source = SimpleNamespace(name="walk", rate_hz=10.0, camera=camera_from_fov(32, 24, 60.0))
    source_class = type("Source", (SimpleNamespace,), {"__iter__": lambda _: iter(frames), "__len__": lambda _: 2})
    sequence = resized_frames(source_class(**vars(source)), (64, 48))
    first, second = sequence
    assert (len(sequence), sequence.name, sequence.rate_hz) == (2, "walk", 10.0)
    assert first.image is not None
    assert first.image.shape == (48, 64)
    assert first.image[20:28, 20:28].min() == 200
    assert second is frames[1]
    np.testing.assert_allclose(sequence.camera.unproject([[31.5, 23.5]]), source.camera.unproject([[15.5, 11.5]]))
