"""What a file itself says of its camera: EXIF of a photograph, metadata in a video's container (QuickTime, MP4).

A QuickTime file is a tree of boxes: size, four letters, content. Apple's cameras keep names (`keys`) and values
(`ilst`) in a box `meta` of the film or of a track, as do some programs. Others note no focal length.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from PIL import ExifTags, Image, UnidentifiedImageError

KEY = "com.apple.quicktime.camera.focal_length.35mm_equivalent"
PARENTS = (b"moov", b"trak", b"udta")
"""Boxes in which there may be a `meta`, within each other."""
HEAD, EDITS = (b"moov", b"mvhd"), (b"moov", b"trak", b"edts", b"elst")
MAX_BOXES, MAX_DEPTH = 10_000, 4
"""In one file, and within each other: a broken one may hold any number."""
MAX_BYTES = 2**20
"""Of a list of names or values; real ones have a few hundred."""
TEXT, FLOATS = 1, {23: ">f", 24: ">d"}
SIGNED, UNSIGNED = (21, 65, 66, 67, 74), (22, 75, 76, 77, 78)
"""Types of values."""
DIAGONAL_35MM = 43.267
"""Of the 36 x 24 mm frame that equivalent focal lengths refer to."""
MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0}
"""Of `FocalPlaneResolutionUnit`: inch, centimetre, millimetre."""
LIKELY = (0.3, 20.0)
"""Focal lengths over the image's longer side that a lens may have; anything else is a mistake."""
SIGMA = 0.05
"""Of its logarithm: whole millimetres of 26 leave 2 %, and diagonal or width, whichever is meant, 4 %."""
SAME_SHAPE = 0.02
"""Relative difference of two aspect ratios up to which an image has only been scaled, not cropped."""


def equivalent_focal_mm(path: Path) -> float | None:
    """Return the focal length that a camera of 36 x 24 mm would need for the same view, or None.

    None if the file is no such container, or is broken before the value. A value that cannot be read is passed over:
    the film and each track may have one.
    """
    try:
        with path.open("rb") as file:
            boxes = _Boxes(file)
            for names, start, stop in boxes.walk(PARENTS):
                if names[-1] == b"meta":
                    for found in _in_meta(boxes, start, stop):
                        if math.isfinite(found) and found > 0:
                            return found
    except (OSError, struct.error):
        pass
    return None


def edited_s(path: Path) -> float | None:
    """Return the seconds that the edit lists of a film leave of its longest track; None where it has none."""
    try:
        with path.open("rb") as file:
            boxes = _Boxes(file)
            found = list(boxes.walk((b"moov", b"trak", b"edts")))
            heads = [boxes.content(*at) for names, *at in found if names == HEAD]
            lengths = [_edited_units(boxes.content(*at)) for names, *at in found if names == EDITS]
            units_s = struct.unpack_from(">I", heads[0], 20 if heads[0][0] else 12)[0] if heads else 0
    except (OSError, struct.error, IndexError):
        return None
    return max(lengths) / units_s if lengths and units_s else None


def _edited_units(content: bytes) -> int:
    """Return the length of an edit list in the film's unit of time; stretches of nothing do not count."""
    entry = ">Qqi" if content[0] else ">Iii"
    (n,) = struct.unpack_from(">I", content, 4)
    parts = [struct.unpack_from(entry, content, 8 + struct.calcsize(entry) * i) for i in range(min(n, MAX_BOXES))]
    return sum(length for length, begins, _ in parts if begins >= 0)


class _Boxes:
    """The boxes of a file, of which none reaches out of the one that it is in."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._left = MAX_BOXES

    def walk(self, parents: tuple[bytes, ...]) -> Iterator[tuple[tuple[bytes, ...], int, int]]:
        """Yield the names that lead to each box, and where its content is; only `parents` are looked into."""
        yield from self._below((), 0, self._file.seek(0, 2), parents)

    def _below(
        self, above: tuple[bytes, ...], start: int, stop: int, parents: tuple[bytes, ...]
    ) -> Iterator[tuple[tuple[bytes, ...], int, int]]:
        for name, first, end in self.within(start, stop):
            yield (*above, name), first, end
            if name in parents and len(above) < MAX_DEPTH:
                yield from self._below((*above, name), first, end, parents)

    def within(self, start: int, stop: int) -> Iterator[tuple[bytes, int, int]]:
        """Yield each box's name, and where its content starts and stops."""
        while start + 8 <= stop and self._left > 0:
            self._left -= 1
            size, name = struct.unpack(">I4s", self._read(start, 8))
            content = start + 8
            if size == 1 and content + 8 <= stop:
                (size,) = struct.unpack(">Q", self._read(content, 8))
                content += 8
            end = stop if size == 0 else start + size
            if end < content or end > stop:
                return  # torn, or no box
            yield name, content, end
            start = end

    def content(self, start: int, stop: int) -> bytes:
        """Return what is in a box; nothing of one that is too long, or too short, to be what it says."""
        return self._read(start, stop - start) if 0 <= stop - start <= MAX_BYTES else b""

    def _read(self, start: int, size: int) -> bytes:
        self._file.seek(start)
        return self._file.read(size)


def _in_meta(boxes: _Boxes, start: int, stop: int) -> Iterator[float]:
    """Yield the focal lengths of one list of names and values."""
    if boxes.content(start + 4, min(start + 8, stop)) != b"hdlr":  # as MP4 has it: four bytes of a version first
        start += 4
    numbers: set[int] = set()
    for name, inner, end in boxes.within(start, stop):
        if name == b"keys":
            numbers = {n for n, key in enumerate(_keys(boxes.content(inner, end)), 1) if key == KEY.encode()}
        elif name == b"ilst":
            for number, item, item_end in boxes.within(inner, end):
                if int.from_bytes(number, "big") in numbers:
                    yield from _values(boxes, item, item_end)


def _keys(content: bytes) -> Iterator[bytes]:
    """Yield the names: each has its size and the four letters of its kind before it."""
    at = 8  # a version, and how many there are
    while at + 8 <= len(content):
        (size,) = struct.unpack_from(">I", content, at)
        if size < 8:
            return
        yield content[at + 8 : at + size]
        at += size


def _values(boxes: _Boxes, start: int, stop: int) -> Iterator[float]:
    for name, inner, end in boxes.within(start, stop):
        if name != b"data" or end - inner < 8:
            continue
        content = boxes.content(inner, end)
        try:
            value = _number(int.from_bytes(content[1:4], "big"), content[8:])
        except (ValueError, OverflowError, struct.error):
            continue
        if value is not None:
            yield value


def _number(kind: int, value: bytes) -> float | None:
    """Return a value of one of the known types, None of another; raise where it is not what its type says."""
    if kind == TEXT:
        return float(value.decode("ascii").strip("\0 ").removesuffix("mm"))
    if kind in FLOATS:
        return float(struct.unpack(FLOATS[kind], value)[0])
    if kind in SIGNED or kind in UNSIGNED:
        return float(int.from_bytes(value, "big", signed=kind in SIGNED))
    return None


def focal_over_longer_side(path: Path) -> float | None:
    """Return a photograph's focal length in pixels, over the longer side of its image.

    By the pitch of the sensor's pixels if known, else by the equivalent focal length of a 35 mm camera. None if neither
    is known, the file is no photograph, or it was cropped since.
    """
    try:
        with Image.open(path) as image:
            width, height = image.size
            told: Mapping[int, Any] = image.getexif().get_ifd(ExifTags.IFD.Exif)
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError):
        return None
    tag = ExifTags.Base
    taken = _exif_number(told, tag.ExifImageWidth), _exif_number(told, tag.ExifImageHeight)
    if taken[0] and taken[1] and abs(_aspect(taken[0], taken[1]) / _aspect(width, height) - 1.0) > SAME_SHAPE:
        return None
    focal_mm, pixels_per_unit = _exif_number(told, tag.FocalLength), _exif_number(told, tag.FocalPlaneXResolution)
    mm = MM_PER_UNIT.get(int(_exif_number(told, tag.FocalPlaneResolutionUnit) or 2))
    if focal_mm and pixels_per_unit and mm and taken[0] and taken[1]:
        ratio = focal_mm * pixels_per_unit / mm / max(taken[0], taken[1])
    elif equivalent_mm := _exif_number(told, tag.FocalLengthIn35mmFilm):
        ratio = over_longer_side(equivalent_mm, width, height)
    else:
        return None
    return ratio if is_likely(ratio) else None


def over_longer_side(equivalent_mm: float, width: float, height: float) -> float:
    """Return the focal length over an image's longer side that belongs to one of a 36 x 24 mm camera."""
    return equivalent_mm / DIAGONAL_35MM * math.hypot(width, height) / max(width, height)


def is_likely(ratio: float) -> bool:
    """Whether a lens may have this focal length, over the image's longer side."""
    return LIKELY[0] < ratio < LIKELY[1]


def _exif_number(told: Mapping[int, Any], tag: int) -> float | None:
    """Return a tag's value; None where it is missing, or no finite positive number."""
    try:
        value = float(told[tag])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    return value if math.isfinite(value) and value > 0 else None


def _aspect(width: float, height: float) -> float:
    return max(width, height) / min(width, height)
