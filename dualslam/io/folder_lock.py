"""One writer at a time in a folder."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

from dualslam.core.errors import OutputError


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
