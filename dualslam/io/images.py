"""Images of a sequence as files, in a folder or in a zip archive: found, put in order and decoded."""

from __future__ import annotations

import logging
import re
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.camera.focal import ToldFocal
from dualslam.core.errors import InputError
from dualslam.io import exif
from dualslam.io.bit_depth import WHOLE, decoded, other_type, used_bits

log = logging.getLogger(__name__)

SHARE_OF_DEPTH = 0.5
"""Depth images for each other one: a few names with the word mean something else."""
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp"})
# How the files of a format end; a file without its ending was cut off, which decoders fill with grey and do not tell.
_ENDINGS = {b"\xff\xd8\xff": b"\xff\xd9", b"\x89PNG": b"IEND\xaeB`\x82"}
_TAIL_BYTES = 1024
_TORN = (zipfile.BadZipFile, zlib.error, OSError, EOFError, NotImplementedError, RuntimeError)  # what zipfile raises
# A JPEG's thumbnail, which has an ending of its own, is in its first 64 KiB. Behind the image there may be more: phones
# append a film.
_HEAD_BYTES = 1 << 16


class UnreadableImageError(Exception):
    """One image of a sequence cannot be had. Its message is the sentence that the frame carries; reading goes on."""


class ImageReader(Protocol):
    """Gives images by their position in the source. Used by one thread."""

    def read(self, index: int) -> NDArray[np.uint8]:
        """Return (H, W) or (H, W, 3) RGB; raise `UnreadableImageError`."""
        ...

    def close(self) -> None:
        """Let go of what is open."""
        ...


class ImageStore(Protocol):
    """The images of a source; every reading of the sequence opens a reader of its own."""

    def __len__(self) -> int: ...

    def reader(self, grey: bool) -> ImageReader:
        """Return a new reader; `grey` images are (H, W), others (H, W, 3) RGB."""
        ...

    def told_focal(self) -> ToldFocal | None:
        """Return the focal length that the source's own data tell, or None."""
        ...


def natural_key(name: str) -> list[tuple[int, int | str]]:
    """Sort key under which frame2 comes before frame10."""
    return [(0, int(part)) if part.isdigit() else (1, part.lower()) for part in re.split(r"(\d+)", name) if part]


def list_images(folder: Path) -> list[Path]:
    """Return the image files of a folder in natural order.

    Raises `InputError` if the folder is missing or holds no image.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} does not exist or is no folder; it should hold the images.")
    found = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]
    if not found:
        raise InputError(f"{folder} holds no images ({', '.join(sorted(IMAGE_SUFFIXES))}); check the path.")
    return sorted(_without_depth(found), key=lambda p: natural_key(p.name))


def _without_depth(paths: list[Path]) -> list[Path]:
    """Leave out depth images, by their names, where they lie among as many others: 7-Scenes, ScanNet, Azure Kinect."""
    others = [p for p in paths if "depth" not in p.stem.lower()]
    n_depth = len(paths) - len(others)
    if not others or n_depth < SHARE_OF_DEPTH * len(others):
        return paths
    log.warning("%s: %d images called depth are left out", paths[0].parent, n_depth)
    return others


def fill_gaps(paths: Sequence[Path], expected: int) -> list[Path]:
    """Put the missing numbers back into a list of numbered files, if that makes it `expected` long.

    A sequence of which a few images were lost can then be read with those frames unreadable, each at its own time.
    Where the numbers do not tell for sure which images are missing the list is returned as it is.
    """
    stems = [p.stem for p in paths]
    widths = {len(s) for s in stems}
    padded = any(s.startswith("0") and len(s) > 1 for s in stems)
    if len(paths) >= expected or not all(s.isdigit() for s in stems) or (padded and len(widths) > 1):
        return list(paths)
    by_number = {int(s): p for s, p in zip(stems, paths, strict=True)}
    first, last = min(by_number), max(by_number)
    if last - first + 1 != expected:
        return list(paths)
    width, template = min(widths), paths[0]
    return [by_number.get(n, template.with_stem(f"{n:0{width}d}")) for n in range(first, last + 1)]


def decode(data: bytes, name: str, grey: bool, bits: int = WHOLE) -> NDArray[np.uint8]:
    """Decode a file's bytes to (H, W) grey or (H, W, 3) RGB.

    `name` is for the message of `UnreadableImageError`; `bits`: how many of 16 the source uses (`used_bits`).
    """
    if not data:
        raise UnreadableImageError(f"{name} is empty.")
    for start, end in _ENDINGS.items():
        if data.startswith(start) and end not in data[-_TAIL_BYTES:] and data.find(end, _HEAD_BYTES) < 0:
            raise UnreadableImageError(f"{name} is cut off: its end is missing.")
    image = decoded(data, grey, bits)
    if image is None and (found := other_type(data)) is not None:
        raise UnreadableImageError(f"{name} has values of type {found}; write it as an image of 8 or 16 bits.")
    if image is None:
        raise UnreadableImageError(f"{name} cannot be decoded: it is damaged or no image.")
    return np.asarray(image if grey else cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


class ImageFiles:
    """Images that are files on the disk."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths = list(paths)
        self._bits: int | None = None

    def __len__(self) -> int:
        return len(self.paths)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the files' names without suffix."""
        return tuple(path.stem for path in self.paths)

    def reader(self, grey: bool) -> ImageReader:
        """Return a reader of these files."""
        if self._bits is None:
            self._bits = used_bits(len(self), lambda i: _bytes_of(self.paths[i]), str(self.paths[0].parent))
        return _FileReader(self.paths, grey, self._bits)

    def told_focal(self) -> ToldFocal | None:
        """Return what the EXIF data of the first image tell."""
        ratio = exif.focal_over_longer_side(self.paths[0])
        return None if ratio is None else ToldFocal(ratio, exif.SIGMA)


def _bytes_of(path: Path) -> bytes | None:
    try:
        return path.read_bytes()
    except (OSError, ValueError):  # a name of a damaged list may be none (NUL)
        return None  # reported where the frame is read


class _FileReader:
    def __init__(self, paths: list[Path], grey: bool, bits: int) -> None:
        self._paths = paths
        self._grey, self._bits = grey, bits

    def read(self, index: int) -> NDArray[np.uint8]:
        path = self._paths[index]
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            raise UnreadableImageError(f"{path} does not exist.") from None
        except OSError as e:
            raise UnreadableImageError(f"{path} cannot be read: {e.strerror or e}.") from e
        except ValueError as e:
            raise UnreadableImageError(f"{str(path)!r} is no name of a file: {e}.") from e
        return decode(data, str(path), self._grey, self._bits)

    def close(self) -> None:
        pass


class ZippedImages:
    """Images inside a zip archive, read in place."""

    def __init__(self, archive: Path) -> None:
        self.archive = archive
        try:
            with zipfile.ZipFile(archive) as opened:
                names = [n for n in opened.namelist() if Path(n).suffix.lower() in IMAGE_SUFFIXES]
        except (OSError, zipfile.BadZipFile) as e:
            raise InputError(f"{archive} cannot be read as a zip archive: {e}; fetch it again.") from e
        # macOS adds a shadow file "._name" for every image.
        self.names = sorted((n for n in names if not Path(n).name.startswith(".")), key=natural_key)
        if not self.names:
            raise InputError(f"{archive} holds no images ({', '.join(sorted(IMAGE_SUFFIXES))}); check the archive.")
        self._bits: int | None = None

    def __len__(self) -> int:
        return len(self.names)

    def reader(self, grey: bool) -> ImageReader:
        """Return a reader with its own handle of the archive."""
        reader = _ZipReader(self.archive, self.names, grey)
        if self._bits is None:
            self._bits = used_bits(len(self), reader.bytes_of, str(self.archive))
        reader.bits = self._bits
        return reader

    def told_focal(self) -> None:
        """Return nothing: recordings in archives have a calibration."""


class _ZipReader:
    def __init__(self, archive: Path, names: list[str], grey: bool) -> None:
        self._zip = zipfile.ZipFile(archive)
        self._names = names
        self._grey = grey
        self.bits = WHOLE

    def read(self, index: int) -> NDArray[np.uint8]:
        where = f"{self._names[index]} in {self._zip.filename}"
        try:
            data = self._zip.read(self._names[index])
        except _TORN as e:
            raise UnreadableImageError(f"{where} cannot be read: {e}.") from e
        return decode(data, where, self._grey, self.bits)

    def bytes_of(self, index: int) -> bytes | None:
        try:
            return self._zip.read(self._names[index])
        except _TORN:
            return None  # reported where the frame is read

    def close(self) -> None:
        self._zip.close()
