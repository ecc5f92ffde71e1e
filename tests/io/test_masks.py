"""Masks that a user brings: one image, or one for each frame."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from dualslam.cli import main
from dualslam.core.errors import InputError
from dualslam.io import open_sequence
from dualslam.io.masks import hidden_pixels, masked, read_mask

WIDTH, HEIGHT, N = 43, 31, 3


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three grey frames."""
    (tmp_path / "images").mkdir()
    for i in range(N):
        cv2.imwrite(str(tmp_path / "images" / f"{i:03d}.png"), np.full((HEIGHT, WIDTH), 50 + i, np.uint8))
    (tmp_path / "times.txt").write_text("0\n0.1\n0.2\n")
    (tmp_path / "calib.txt").write_text(f"50 52 20.5 14.5 {WIDTH} {HEIGHT}\n")
    return tmp_path


def write(path: Path, n_black_rows: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    path.parent.mkdir(exist_ok=True)
    mask = np.full((size[1], size[0]), 255, np.uint8)
    mask[:n_black_rows] = 0
    cv2.imwrite(str(path), mask)
    return path


def n_hidden_rows(folder: Path, mask: Path, **selection: int) -> list[int]:
    frames = list(masked(open_sequence(folder, **selection), mask))
    assert all(frame.image is not None and frame.hidden is not None for frame in frames)
    return [int(frame.hidden.all(axis=1).sum()) for frame in frames]  # type: ignore[union-attr]


def test_one_mask_is_that_of_all_frames(folder: Path) -> None:
    mask = write(folder / "mask.png", 4)
    assert n_hidden_rows(folder, mask) == [4, 4, 4]
    sequence = masked(open_sequence(folder), mask)
    assert len(sequence) == N
    found = np.zeros((HEIGHT, WIDTH), np.bool_)
    found[-2:] = True
    both = hidden_pixels(sequence, found)
    assert both is not None
    assert int(both.all(axis=1).sum()) == 6


def test_without_a_mask_the_sequence_is_as_it_was(folder: Path) -> None:
    sequence = open_sequence(folder)
    assert masked(sequence, None) is sequence
    assert hidden_pixels(sequence, None) is None


def test_a_lossy_mask_has_two_levels_all_the_same(folder: Path) -> None:
    mask = write(folder / "mask.jpg", 16)
    assert int(read_mask(mask, (WIDTH, HEIGHT)).all(axis=1).sum()) == 16


@pytest.mark.parametrize("kind", ["grey", "rgb", "zeros and ones", "16 bits", "transparent"])
def test_masks_of_any_kind(folder: Path, tmp_path: Path, kind: str) -> None:
    scene = np.ones((HEIGHT, WIDTH), np.uint8)
    scene[:5] = 0
    images = {
        "grey": 255 * scene,
        "rgb": np.repeat(255 * scene[..., None], 3, axis=2),
        "zeros and ones": scene,
        "16 bits": 65535 * scene.astype(np.uint16),
        "transparent": np.dstack([np.full((HEIGHT, WIDTH, 3), 255, np.uint8), 255 * scene]),
    }
    cv2.imwrite(str(tmp_path / "mask.png"), images[kind])
    assert n_hidden_rows(folder, tmp_path / "mask.png") == [5] * N


@pytest.mark.parametrize("n_black_rows", [0, HEIGHT - 1])
def test_a_mask_that_hides_nothing_or_nearly_all_is_doubted(
    folder: Path, tmp_path: Path, n_black_rows: int, caplog: pytest.LogCaptureFixture
) -> None:
    assert n_hidden_rows(folder, write(tmp_path / "mask.png", n_black_rows)) == [n_black_rows] * N
    assert "black is hidden, white is scene" in caplog.text


@pytest.mark.parametrize("names", [["000", "001", "002"], ["a", "b", "c"]])
def test_a_folder_has_a_mask_for_each_frame_by_name_or_in_order(folder: Path, names: list[str]) -> None:
    for n, name in enumerate(names):
        write(folder / "masks" / f"{name}.png", n)
    assert n_hidden_rows(folder, folder / "masks") == [0, 1, 2]
    assert n_hidden_rows(folder, folder / "masks", start=1) == [1, 2]


def test_masks_named_as_frames_need_not_be_there_for_frames_that_are_not_read(folder: Path) -> None:
    write(folder / "masks" / "002.png", 7)
    assert n_hidden_rows(folder, folder / "masks", start=2) == [7]


def test_a_mask_of_the_frames_before_they_were_read_smaller(tmp_path: Path) -> None:
    """A small pixel is scene where all pixels that it covers are."""
    mask = write(tmp_path / "mask.png", 5, size=(2 * WIDTH + 1, 2 * HEIGHT))
    assert int(read_mask(mask, (WIDTH, HEIGHT)).all(axis=1).sum()) == 3


def test_what_cannot_be_used_is_refused_in_one_sentence(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(folder / "masks" / "000.png", 1)
    write(folder / "masks" / "001.png", 1)
    (folder / "torn.png").write_bytes(b"no image")
    cases = {
        "none.png": "does not exist",
        str(write(folder / "wide.png", 1, size=(50, HEIGHT)).name): "is 50 x 31 pixels, the frames 43 x 31",
        str(write(folder / "black.png", HEIGHT).name): "is black",
        "torn.png": "cannot be read as an image",
        "masks": r"frame 2 \(002\) has none; there are 2 masks",
    }
    for name, words in cases.items():
        with pytest.raises(InputError, match=words):
            masked(open_sequence(folder), folder / name)
    out = str(tmp_path / "out")
    assert main(["run", str(folder), "--mask", str(folder / "wide.png"), "--out", out, "--quiet"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert "wide.png is 50 x 31 pixels" in lines[0]
