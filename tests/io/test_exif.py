"""The focal length in a photograph's EXIF data."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from PIL import ExifTags, Image

from dualslam.io.file_metadata import focal_over_longer_side

TAG = ExifTags.Base


def photograph(folder: Path, size: tuple[int, int] = (400, 300), **told: float) -> Path:
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif).update({TAG[name]: value for name, value in told.items()})
    path = folder / "photograph.jpg"
    Image.new("L", size).save(path, exif=exif)
    return path


def test_an_equivalent_is_of_the_diagonal(tmp_path: Path) -> None:
    assert focal_over_longer_side(photograph(tmp_path, FocalLengthIn35mmFilm=26)) == pytest.approx(26 / 43.267 * 1.25)
    upright = photograph(tmp_path, (300, 400), FocalLengthIn35mmFilm=26)
    assert focal_over_longer_side(upright) == pytest.approx(26 / 43.267 * 1.25)


@pytest.mark.parametrize(("unit", "per_unit"), [(2, 25.4 * 250), (3, 2500), (4, 250)])
def test_the_pitch_of_the_pixels_goes_first(tmp_path: Path, unit: int, per_unit: float) -> None:
    """A lens of 8 mm before pixels of 4 micrometres, 4000 of them; the image was made smaller since."""
    told = {"ExifImageWidth": 4000, "ExifImageHeight": 3000, "FocalLength": 8.0, "FocalLengthIn35mmFilm": 99}
    path = photograph(tmp_path, **told, FocalPlaneXResolution=per_unit, FocalPlaneResolutionUnit=unit)
    assert focal_over_longer_side(path) == pytest.approx(8 * 250 / 4000)


@pytest.mark.parametrize(
    "told",
    [
        {},
        {"FocalLength": 4.2},
        {"FocalLengthIn35mmFilm": 0},
        {"FocalLengthIn35mmFilm": 2},
        {"FocalLengthIn35mmFilm": 26, "ExifImageWidth": 4000, "ExifImageHeight": 2250},
    ],
    ids=["nothing", "a lens without a sensor", "zero", "no lens there is", "cropped since"],
)
def test_what_is_not_told_is_not_made_up(tmp_path: Path, told: dict[str, float]) -> None:
    assert focal_over_longer_side(photograph(tmp_path, **told)) is None


def test_what_is_no_photograph_tells_nothing(tmp_path: Path) -> None:
    for name, content in (("text.jpg", b"no image"), ("empty.png", b"")):
        (tmp_path / name).write_bytes(content)
        assert focal_over_longer_side(tmp_path / name) is None
    assert focal_over_longer_side(tmp_path / "missing.jpg") is None
    assert math.isfinite(focal_over_longer_side(photograph(tmp_path, FocalLengthIn35mmFilm=35)) or math.nan)
