"""Files that appear whole or not at all, and folders in which one run writes at a time."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from dualslam.core.errors import OutputError


@contextmanager
def atomic_file(path: Path) -> Iterator[IO[bytes]]:
    """Open a file for writing (bytes) that takes the place of `path` only when the block ends without an exception.

    The new content is on the disk before the rename, so a crash at any moment leaves the old file or the new one.

    Raises `OutputError` if the folder cannot be written to.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
    except OSError as e:
        raise OutputError(f"{path} cannot be written: {e.strerror or e}; choose another folder.") from e
    part = Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        # mkstemp makes files private to the user; results follow the umask, which can only be read by setting it.
        os.umask(mask := os.umask(0o022))
        part.chmod(0o666 & ~mask)
        part.replace(path)
    except OSError as e:
        raise OutputError(f"{path} cannot be written: {e.strerror or e}.") from e
    finally:
        part.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically."""
    with atomic_file(path) as file:
        file.write(content)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically, UTF-8."""
    # A file's name may hold bytes that the locale does not know: they go back as they came.
    write_bytes(path, text.encode(errors="surrogateescape"))


class FolderLock:
    """Holds a folder until it is released or the process ends, however it ends; there is no file to be left behind.

    Raises `OutputError` if another one holds it.
    Raises `OSError` if the folder cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self._descriptor: int | None = os.open(path, os.O_RDONLY)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.release()
            raise OutputError(f"{path} is being written to by another run; choose another folder.") from None
        except OSError:  # some network file systems lock no folders: there two runs are for the user to keep apart
            self.release()

    def release(self) -> None:
        """Let go of it; more than once does no harm."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None
