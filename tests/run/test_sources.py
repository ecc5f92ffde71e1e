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


def test_a_webcam_is_refused_for_what_it_is() -> None:
    with pytest.raises(InputError, match="0 is live: its frames cannot be read again"):
        open_images_of_run("0", SIZE)


def test_images_of_another_size_are_refused(folder: Path) -> None:
    with pytest.raises(InputError, match="another size"):
        open_images_of_run(folder, (640, 480))


def test_images_of_another_place_are_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    scenes = [cv2.resize(rng.integers(0, 256, (12, 16), np.uint8), (640, 480)) for _ in range(4)]
    for place in ("here", "there"):
        (tmp_path / place).mkdir()
    for i, scene in enumerate(scenes):
        cv2.imwrite(str(tmp_path / "here" / f"{i}.png"), scene)
        cv2.imwrite(str(tmp_path / "there" / f"{i}.png"), scenes[i - 1])
    pictures = {
        i: cv2.imencode(".jpg", cv2.resize(scene, (160, 120), interpolation=cv2.INTER_AREA))[1].tobytes()
        for i, scene in enumerate(scenes)
    }
    assert len(open_images_of_run(tmp_path / "here", (640, 480), pictures=pictures)) == len(scenes)
    for elsewhere in ({i: pictures[i] for i in range(4)}, {9: pictures[0]}):  # other images; not as many
        with pytest.raises(InputError, match="other images"):
            open_images_of_run(tmp_path / "there", (640, 480), pictures=elsewhere)
