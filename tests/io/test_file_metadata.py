"""The focal length that the container of a video tells."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from dualslam.io.file_metadata import KEY, MAX_BOXES, edited_s, equivalent_focal_mm
from dualslam.io.video import CROP_SIGMA, LOG_CROP, VideoFile

OTHER = "com.apple.quicktime.camera.lens_model"


def box(name: bytes, *content: bytes, large: bool = False) -> bytes:
    inner = b"".join(content)
    if large:
        return struct.pack(">I4sQ", 1, name, 16 + len(inner)) + inner
    return struct.pack(">I4s", 8 + len(inner), name) + inner


def data(kind: int, value: bytes) -> bytes:
    return box(b"data", struct.pack(">II", kind, 0), value)


def meta(*items: tuple[str, bytes], version: bool = False, large: bool = False) -> bytes:
    keys = b"".join(box(b"mdta", name.encode()) for name, _ in items)
    values = b"".join(box(struct.pack(">I", n), value) for n, (_, value) in enumerate(items, 1))
    return box(
        b"meta",
        bytes(4) if version else b"",
        box(b"hdlr", bytes(8), b"mdta", bytes(13)),
        box(b"keys", struct.pack(">II", 0, len(items)), keys),
        box(b"ilst", values),
        large=large,
    )


def written(folder: Path, *boxes: bytes) -> Path:
    path = folder / "film.mov"
    path.write_bytes(box(b"ftyp", b"qt  ", bytes(4)) + b"".join(boxes))
    return path


LENS = (OTHER, data(1, b"back camera 5.1mm f/1.6"))


@pytest.mark.parametrize(
    ("kind", "value", "mm"),
    [
        (21, struct.pack(">i", 27), 27),
        (21, struct.pack(">b", 27), 27),
        (22, struct.pack(">H", 65000), 65000),
        (67, struct.pack(">i", 26), 26),
        (78, struct.pack(">Q", 26), 26),
        (23, struct.pack(">f", 26.5), 26.5),
        (24, struct.pack(">d", 26.5), 26.5),
        (1, b"26", 26),
        (1, b"50.00mm", 50),
        (1, b"24.5 \0", 24.5),
    ],
)
def test_values_of_all_types(tmp_path: Path, kind: int, value: bytes, mm: float) -> None:
    path = written(tmp_path, box(b"moov", meta(LENS, (KEY, data(kind, value)))))
    assert equivalent_focal_mm(path) == pytest.approx(mm)


def test_wherever_it_stands(tmp_path: Path) -> None:
    told = meta(LENS, (KEY, data(21, b"\x1a")))
    track = box(b"trak", box(b"tkhd", bytes(84)))
    for boxes in (
        [box(b"mdat", bytes(100)), box(b"moov", box(b"mvhd", bytes(100)), track, told)],
        [box(b"moov", track, box(b"trak", box(b"tkhd", bytes(84)), told))],
        [box(b"moov", box(b"udta", meta((KEY, data(21, b"\x1a")), version=True)))],
        [box(b"moov", meta((KEY, data(21, b"\x1a")), large=True))],
        [box(b"mdat", bytes(100), large=True), box(b"moov", meta(LENS), told)],
        [struct.pack(">I4s", 0, b"moov") + told],
    ):
        assert equivalent_focal_mm(written(tmp_path, *boxes)) == 26


@pytest.mark.parametrize(
    "value",
    [
        data(22, b"\xff" * 200),
        data(1, b"wide"),
        data(1, b"\xff\xfe"),
        data(23, b"\0"),
        data(21, b"\0"),
        data(21, b""),
        data(13, b"\x1a"),
    ]
    + [data(23, struct.pack(">f", math.nan)), data(1, b"-26"), box(b"data", b"\0\0"), b"", box(b"name", b"26")],
)
def test_what_is_no_focal_length_is_none(tmp_path: Path, value: bytes) -> None:
    assert equivalent_focal_mm(written(tmp_path, box(b"moov", meta((KEY, value))))) is None


@pytest.mark.parametrize(
    "value", [data(1, b"wide"), data(23, b"\0"), data(22, b"\xff" * 200), data(21, bytes(2**20)), box(b"data", b"\0\0")]
)
def test_one_that_cannot_be_read_is_passed_over(tmp_path: Path, value: bytes) -> None:
    """In the film, in a track, or beside another value of the same name."""
    good = data(21, b"\x1a")
    for boxes in (
        [meta((KEY, value)), box(b"trak", meta((KEY, good)))],
        [box(b"trak", meta((KEY, value))), meta((KEY, good))],
        [meta((KEY, value), (KEY, good))],
        [meta((KEY, value + good))],
    ):
        assert equivalent_focal_mm(written(tmp_path, box(b"moov", *boxes))) == 26


def test_films_without_one_tell_none(tmp_path: Path) -> None:
    assert equivalent_focal_mm(written(tmp_path, box(b"moov", meta(LENS)))) is None
    assert equivalent_focal_mm(written(tmp_path)) is None
    assert equivalent_focal_mm(tmp_path / "missing.mov") is None
    (tmp_path / "empty.mp4").touch()
    assert equivalent_focal_mm(tmp_path / "empty.mp4") is None


def test_a_film_that_is_torn_anywhere_or_has_any_byte_wrong_ends_the_search(tmp_path: Path) -> None:
    whole = written(tmp_path, box(b"moov", box(b"trak", meta(LENS, (KEY, data(21, b"\x1a")))))).read_bytes()
    torn = tmp_path / "torn.mov"
    for n in range(len(whole)):
        torn.write_bytes(whole[:n])
        assert equivalent_focal_mm(torn) is None
        torn.write_bytes(whole[:n] + bytes([whole[n] ^ 0xFF]) + whole[n + 1 :])
        assert equivalent_focal_mm(torn) in (None, 26)


def test_boxes_without_end_end(tmp_path: Path) -> None:
    told = box(b"moov", meta((KEY, data(21, b"\x1a"))))
    assert equivalent_focal_mm(written(tmp_path, box(b"free") * (2 * MAX_BOXES), told)) is None
    deep = told
    for _ in range(2000):
        deep = box(b"moov", deep)
    assert equivalent_focal_mm(written(tmp_path, deep)) is None
    huge = struct.pack(">I4sQ", 1, b"moov", 2**63) + bytes(100)
    assert equivalent_focal_mm(written(tmp_path, huge)) is None


# --- a real film

UPRIGHT = (0, 1 << 16, 0, -(1 << 16), 0, 0, 36 << 16, 0, 1 << 30)
"""The matrix of a film that is to be turned by a quarter."""


def film(path: Path, mm: int, matrix: tuple[int, ...] | None) -> VideoFile:
    """Write a film of 64 x 36 whose telephone has noted a focal length, and perhaps that it was held upright."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (64, 36))
    if not writer.isOpened():
        pytest.skip("this OpenCV has no MPEG-4 encoder")
    for i in range(4):
        writer.write(np.full((36, 64, 3), 20 * i, np.uint8))
    writer.release()
    content = path.read_bytes()
    at = content.rindex(b"moov") - 4
    assert at + int.from_bytes(content[at : at + 4], "big") == len(content), "the film ends with it: it may grow"
    moov = bytearray(content[at + 8 :])
    if matrix is not None:
        to = moov.index(b"tkhd") + 4 + 40
        moov[to : to + 36] = struct.pack(">9i", *matrix)
    path.write_bytes(content[:at] + box(b"moov", bytes(moov), meta(LENS, (KEY, data(21, bytes([mm]))))))
    return VideoFile(path)


def test_a_film_is_cropped_more_than_its_container_says(tmp_path: Path) -> None:
    """By the diagonal of 16:9; however it was held, over the longer side."""
    lying, upright = (film(tmp_path / f"{m}.mp4", 26, m) for m in (None, UPRIGHT))
    shapes = [video.reader(grey=True).read(0).shape for video in (lying, upright)]
    assert shapes == [(36, 64), (64, 36)], "OpenCV turns it"
    for video in (lying, upright):
        told = video.told_focal()
        assert told is not None
        uncropped = 26 / math.hypot(36, 24) * math.hypot(16, 9) / 16
        assert told.over_side == pytest.approx(uncropped * math.exp(LOG_CROP), rel=1e-4)
        assert 1.0 < told.over_side / uncropped < math.exp(2 * LOG_CROP)
        assert told.log_sigma == CROP_SIGMA


def test_a_focal_length_that_no_lens_has_is_not_told(tmp_path: Path) -> None:
    assert film(tmp_path / "film.mp4", 2, None).told_focal() is None


def test_a_variable_frame_rate_is_told_by_each_frame(tmp_path: Path) -> None:
    """Two frames as they were written, two that last twice as long: the table of durations has one more row."""
    path = tmp_path / "film.mp4"
    film(path, 26, None)
    content = bytearray(path.read_bytes())
    at = content.index(b"stts")
    n, count, ticks = struct.unpack(">3I", content[at + 8 : at + 20])
    assert (n, count) == (1, 4)
    content[at + 8 : at + 20] = struct.pack(">5I", 2, 2, ticks, 2, 2 * ticks)
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stts"):  # all that it stands in
        size = content.index(name) - 4
        content[size : size + 4] = (int.from_bytes(content[size : size + 4], "big") + 8).to_bytes(4, "big")
    path.write_bytes(content)
    assert VideoFile(path).timestamps_s == pytest.approx(np.array([0, 1, 2, 4]) / 30)


def test_a_clip_trimmed_in_place_does_not_end_early(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    whole = tmp_path / "whole.mp4"
    writer = cv2.VideoWriter(str(whole), cv2.VideoWriter_fourcc(*"mp4v"), 30.0, (64, 48))
    for i in range(30):
        writer.write(np.full((48, 64, 3), 8 * i, np.uint8))
    writer.release()
    assert edited_s(whole) == pytest.approx(1.0)
    content = bytearray(whole.read_bytes())
    at = content.find(b"elst") + 12
    (length,) = struct.unpack_from(">I", content, at)
    content[at : at + 4] = struct.pack(">I", length // 3)
    trimmed = tmp_path / "trimmed.mp4"
    trimmed.write_bytes(content)
    assert edited_s(trimmed) == pytest.approx(1 / 3, abs=0.01)
    assert len(VideoFile(trimmed)) == pytest.approx(10, abs=1)
    assert caplog.text == ""
    (tmp_path / "none.mp4").write_bytes(box(b"moov", box(b"trak", box(b"edts", box(b"elst", b"\0\0")))))
    assert edited_s(tmp_path / "none.mp4") is None
