"""A folder of images and nothing else: the focal length is searched for, or the person is asked."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from PIL import ExifTags, Image

from dualslam.atlas.atlas import Atlas
from dualslam.core.camera.corrected import LensCorrection, correct
from dualslam.core.camera.focal import FocalSearch
from dualslam.core.camera.models import DivisionCamera, PinholeCamera
from dualslam.core.config.settings import Config
from dualslam.core.errors import InputError
from dualslam.core.types import FloatArray
from dualslam.frontends.tracking import focal_search
from dualslam.io.map_store import save_atlas
from dualslam.lab.synthetic import make_sequence
from dualslam.run.before import open_without_calibration, with_camera_found, with_camera_of_map, with_prior
from dualslam.run.session import SEARCHED_SIGMA, refined_camera
from dualslam.system.system import System


def write(folder: Path, images: list[np.ndarray], exif: Image.Exif | bytes = b"") -> Path:
    folder.mkdir()
    for i, image in enumerate(images):
        Image.fromarray(image).save(folder / f"{i:04d}.png", exif=exif)
    return folder


@pytest.fixture(autouse=True)
def _few_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """For time's sake: they tell less, but enough for these worlds."""
    monkeypatch.setattr(focal_search, "MAX_PAIRS", 12)


@pytest.fixture(scope="module")
def walk() -> tuple[FloatArray, list[np.ndarray]]:
    """The camera's matrix and the images of a walk through a room."""
    world = make_sequence("room", 70, 3, 320, 240)
    return world.camera.K, [frame.image for frame in world]


@pytest.mark.slow
def test_the_beginning_tells_the_field_of_view(walk: tuple[FloatArray, list[np.ndarray]], tmp_path: Path) -> None:
    K, images = walk
    folder = write(tmp_path / "images", images)
    config = Config.model_validate({"frontend": {"n_features": 800}})
    opened = open_without_calibration(str(folder), start=0, stride=1, max_frames=None)
    sequence, found = with_camera_found(config, opened)
    assert sequence.camera.K[0, 0] == pytest.approx(found.focal_px)
    low, high = found.range_px
    assert low <= K[0, 0] <= high
    assert found.focal_px == pytest.approx(K[0, 0], rel=0.1)
    assert len(sequence) == 70


def test_self_calibration_trusts_a_focal_length_as_far_as_it_was_found() -> None:
    config = Config()
    for log_sigma in (0.01, 0.2):
        found = FocalSearch(500.0, log_sigma, 0.0, 640, 480, 20)
        sigma = with_prior(config, found).calibration.log_focal_sigma
        assert sigma == max(config.calibration.log_focal_sigma, log_sigma)


def test_what_became_of_a_searched_camera_is_as_unsure_as_its_lens() -> None:
    calibrated = cast(
        System, SimpleNamespace(log_focal_sigma=0.01, camera=PinholeCamera(64, 48, 50.0, 50.0, 31.5, 23.5))
    )
    given, searched = (refined_camera(calibrated, was_searched) for was_searched in (False, True))
    assert given is not None
    assert searched is not None
    assert given["log_focal_sigma"] == 0.01
    assert searched["log_focal_sigma"] == pytest.approx(np.hypot(0.01, SEARCHED_SIGMA))
    untouched = cast(System, SimpleNamespace(log_focal_sigma=None))
    assert refined_camera(untouched, True) is None


def test_where_nothing_moves_the_person_is_asked(tmp_path: Path) -> None:
    image = make_sequence("room", 2, 3, 320, 240).frame(0).image
    folder = write(tmp_path / "images", [image] * 12)
    with pytest.raises(InputError, match=r"give a camera file, or a field of view .*--camera, --fov"):
        with_camera_found(Config(), open_without_calibration(str(folder), start=0, stride=1, max_frames=None))


def told(equivalent_mm: float) -> Image.Exif:
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = "a camera"
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = equivalent_mm
    return exif


def test_where_nothing_moves_exif_data_are_taken_at_their_word(tmp_path: Path) -> None:
    image = make_sequence("room", 2, 3, 320, 240).frame(0).image
    folder = write(tmp_path / "images", [image] * 12, told(30))
    opened = open_without_calibration(str(folder), start=0, stride=1, max_frames=None)
    sequence, found = with_camera_found(Config(), opened)
    assert found.focal_px == found.told_px == pytest.approx(30 / 43.267 * 400)
    assert sequence.camera.K[0, 0] == found.focal_px
    low, high = found.range_px
    assert 0.1 < (high - low) / found.focal_px < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("off", [1.0, 1.6])
def test_the_frames_are_asked_all_the_same(
    walk: tuple[FloatArray, list[np.ndarray]], tmp_path: Path, off: float
) -> None:
    """What is told may be of another lens, or of an image that was cropped: the frames have the last word."""
    true = walk[0][0, 0]
    folder = write(tmp_path / "images", walk[1], told(off * true / 400 * 43.267))
    config = Config.model_validate({"frontend": {"n_features": 800}})
    opened = open_without_calibration(str(folder), start=0, stride=1, max_frames=None)
    _, found = with_camera_found(config, opened)
    assert found.told_px == pytest.approx(off * true, rel=0.02)
    assert found.focal_px == pytest.approx(true, rel=0.05 if off == 1.0 else 0.12)


def test_on_a_saved_map_an_unknown_camera_is_the_one_that_made_it(tmp_path: Path) -> None:
    folder = write(tmp_path / "images", [np.zeros((48, 64), np.uint8)] * 3)
    made_by = DivisionCamera(64, 48, 50.0, 50.0, 31.5, 23.5, k=-0.2)
    save_atlas(tmp_path / "map", Atlas(), {}, correct(made_by, LensCorrection(log_focal=0.02)))
    opened = open_without_calibration(str(folder))
    sequence = with_camera_of_map(tmp_path / "map", opened)
    assert sequence is not None
    assert sequence.camera == made_by, "self-calibration's part comes with the map"
    assert len(list(sequence)) == 3


def test_images_of_half_the_size_are_of_the_map_s_camera_and_those_of_another_shape_are_not(tmp_path: Path) -> None:
    opened = open_without_calibration(str(write(tmp_path / "images", [np.zeros((48, 64), np.uint8)] * 3)))
    save_atlas(tmp_path / "larger", Atlas(), {}, DivisionCamera(128, 96, 50.0, 50.0, 63.5, 47.5, k=-0.2))
    sequence = with_camera_of_map(tmp_path / "larger", opened)
    assert sequence is not None
    assert sequence.camera == DivisionCamera(64, 48, 25.0, 25.0, 31.5, 23.5, k=-0.2)
    save_atlas(tmp_path / "cropped", Atlas(), {}, DivisionCamera(128, 72, 50.0, 50.0, 63.5, 35.5))
    assert with_camera_of_map(tmp_path / "cropped", opened) is None
