"""Opening again what a run was made of."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from dualslam.core.errors import InputError
from dualslam.run.sources import open_images_of_run

SIZE = (64, 48)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Images, and nothing that tells their camera."""
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.full((SIZE[1], SIZE[0]), 10 * i, np.uint8))
    return tmp_path


def test_images_of_an_unknown_camera_are_read_again(folder: Path) -> None:
    assert [int(frame.image[0, 0]) for frame in open_images_of_run(folder, SIZE)] == [0, 10, 20]  # type: ignore[index]


def test_worlds_have_a_camera_of_their_own() -> None:
    opened = open_images_of_run("synthetic:street,frames=2,width=160,height=120", (160, 120))
    assert len(opened) == 2


def test_images_of_another_size_are_refused(folder: Path) -> None:
    with pytest.raises(InputError, match="another size"):
        open_images_of_run(folder, (640, 480))
