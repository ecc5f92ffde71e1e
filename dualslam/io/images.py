"""Images of a sequence as files, in a folder or in a zip archive: found, put in order and decoded."""

from __future__ import annotations

import logging
import re
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dualslam.core.camera.focal import ToldFocal
from dualslam.core.errors import InputError
from dualslam.io import file_metadata
from dualslam.io.decoding import UnreadableImageError, decode, file_values, used_bits

log = logging.getLogger(__name__)

SHARE_OF_DEPTH = 0.5
"""Depth images for each other one: a few names with the word mean something else."""
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp"})
_TORN = (zipfile.BadZipFile, zlib.error, OSError, EOFError, NotImplementedError, RuntimeError)  # what zipfile raises


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


class _EncodedReader:
    """Decodes the files whose bytes `fetch` gives."""

    def __init__(
        self, fetch: Callable[[int], bytes], names: Sequence[str], grey: bool, bits: int, close: Callable[[], None]
    ) -> None:
        self._fetch, self._names, self._grey, self._bits = fetch, names, grey, bits
        self.close = close

    def read(self, index: int) -> NDArray[np.uint8]:
        return decode(self._fetch(index), self._names[index], self._grey, self._bits)


class ImageFiles:
    """Images that are files on the disk."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths = list(paths)
        self.names = tuple(path.stem for path in self.paths)
        self._bits: int | None = None

    def __len__(self) -> int:
        return len(self.paths)

    def reader(self, grey: bool) -> ImageReader:
        """Return a reader of these files."""
        if self._bits is None:
            self._bits = used_bits(len(self), lambda i: file_values(self._fetch(i)), str(self.paths[0].parent))
        return _EncodedReader(self._fetch, [str(path) for path in self.paths], grey, self._bits, lambda: None)

    def _fetch(self, index: int) -> bytes:
        path = self.paths[index]
        try:
            return path.read_bytes()
        except FileNotFoundError:
            raise UnreadableImageError(f"{path} does not exist.") from None
        except OSError as e:
            raise UnreadableImageError(f"{path} cannot be read: {e.strerror or e}.") from e
        except ValueError as e:  # a name of a damaged list may be none (NUL)
            raise UnreadableImageError(f"{str(path)!r} is no name of a file: {e}.") from e

    def told_focal(self) -> ToldFocal | None:
        """Return what the EXIF data of the first image tell."""
        ratio = file_metadata.focal_over_longer_side(self.paths[0])
        return None if ratio is None else ToldFocal(ratio, file_metadata.SIGMA)


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
        opened, named = zipfile.ZipFile(self.archive), [f"{name} in {self.archive}" for name in self.names]

        def fetch(index: int) -> bytes:
            try:
                return opened.read(self.names[index])
            except _TORN as e:
                raise UnreadableImageError(f"{named[index]} cannot be read: {e}.") from e

        if self._bits is None:
            self._bits = used_bits(len(self), lambda i: file_values(fetch(i)), str(self.archive))
        return _EncodedReader(fetch, named, grey, self._bits, opened.close)

    def told_focal(self) -> None:
        """Return nothing: recordings in archives have a calibration."""
