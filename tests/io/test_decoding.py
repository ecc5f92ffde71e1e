"""Images of more than eight bits: the whole source is read alike, and what cannot be read says why."""

from __future__ import annotations

import logging
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from dualslam.core.errors import InputError
from dualslam.io.decoding import N_LOOKED_AT
from dualslam.io.images import ZippedImages
from dualslam.io.open_sequence import open_sequence

RAMP = np.linspace(0, 1, 32 * 24).reshape(24, 32)


def write(folder: Path, brightest: list[int], ending: str = "png", colour: bool = False) -> Path:
    """Write a ramp from 0 up to each of these values, in 16 bits."""
    folder.mkdir()
    for i, top in enumerate(brightest):
        image = np.round(top * RAMP).astype(np.uint16)
        assert cv2.imwrite(str(folder / f"{i:03d}.{ending}"), np.dstack([image] * 3) if colour else image)
    return folder


def brightest_of(folder: Path, **options: object) -> list[int]:
    frames = open_sequence(folder, fov_degrees=60, **options)  # type: ignore[arg-type]
    return [int(frame.image.max()) for frame in frames if frame.image is not None]


@pytest.mark.parametrize("ending", ["png", "tiff", "pgm"])
@pytest.mark.parametrize(("top", "bits"), [(255, 8), (1023, 10), (4095, 12), (16383, 14), (65535, 16), (4000, 12)])
def test_the_bits_that_are_used_are_read(tmp_path: Path, ending: str, top: int, bits: int) -> None:
    (frame,) = open_sequence(write(tmp_path / "s", [top], ending), fov_degrees=60)
    np.testing.assert_array_equal(frame.image, np.round(top * RAMP).astype(int) >> (bits - 8))


def test_one_scale_for_the_whole_source_whatever_part_is_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    tops = [500, 1000, 2000, 3000, 500, 4095, 800]
    folder = write(tmp_path / "s", tops)
    assert brightest_of(folder) == [top >> 4 for top in tops]
    assert [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING and "16 bits" in r.getMessage()] == [
        f"{folder}: its images of 16 bits use 12 of them, and are read as images of 12 bits"
    ]
    assert brightest_of(folder, max_frames=2) == [500 >> 4, 1000 >> 4]
    assert brightest_of(folder, reverse=True) == [top >> 4 for top in reversed(tops)]
    assert brightest_of(folder, grey=False) == [top >> 4 for top in tops]


def test_what_is_brighter_than_all_that_was_looked_at_is_white(tmp_path: Path) -> None:
    tops = [1023] * (2 * N_LOOKED_AT)
    tops[1] = 5000
    assert brightest_of(write(tmp_path / "s", tops))[1] == 255


def test_colour_and_zip(tmp_path: Path) -> None:
    folder = write(tmp_path / "s", [4095, 2000], colour=True)
    assert brightest_of(folder) == [255, 125]
    assert brightest_of(folder, grey=False) == [255, 125]
    with zipfile.ZipFile(tmp_path / "s.zip", "w") as archive:
        for path in sorted(folder.iterdir()):
            archive.write(path, path.name)
    reader = ZippedImages(tmp_path / "s.zip").reader(grey=True)
    assert [int(reader.read(i).max()) for i in range(2)] == [255, 125]
    reader.close()


def test_eight_bits_stay_as_they_are(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Dark ones too, and 16 bits among them."""
    folder = write(tmp_path / "s", [40, 65535, 65535])
    for i in (0, 2):
        cv2.imwrite(str(folder / f"{i:03d}.png"), np.round(40 * RAMP).astype(np.uint8))
    assert brightest_of(folder) == [40, 255, 40]
    assert "16 bits" not in caplog.text


def test_an_image_of_floating_point_numbers_says_what_is_read(dataset: Path) -> None:
    for path in sorted((dataset / "images").iterdir()):
        cv2.imwrite(str(path.with_suffix(".tiff")), RAMP.astype(np.float32))
        path.unlink()
    with pytest.raises(InputError, match="has values of type float32; write it as an image of 8 or 16 bits"):
        open_sequence(dataset)
