"""Standard output and error of a command: what they cannot take costs nothing that is computed."""

from __future__ import annotations

import errno
import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from typing import Any, TextIO, cast

STDERR = 2


class Lenient:
    """A text stream that drops what cannot be written, once its reader has gone or its disk is full (`problem`)."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.problem: OSError | None = None

    def write(self, text: str) -> int:
        """Write, or drop."""
        self._do(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        """Hand on what is held back, or drop it."""
        self._do(self._stream.flush)

    def end(self) -> None:
        """Hand on what is held back; from now on all is dropped."""
        self.flush()
        self.problem = self.problem or OSError(errno.EBADF, os.strerror(errno.EBADF))

    def _do(self, act: Callable[[], object]) -> None:
        if self.problem is not None:
            return
        try:
            act()
        except OSError as problem:
            self.problem = problem
            with suppress(OSError, AttributeError):  # or the interpreter would try again at its end, and complain
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def lenient() -> Iterator[Lenient]:
    """Make standard output and error lenient, and give the former; both may have been closed (``>&-``).

    Letters that the terminal's encoding lacks (LANG=C) are shown by their number.
    """
    with open(os.devnull, "w", encoding="utf-8") as nothing:
        streams = [Lenient(cast("TextIO | None", stream) or nothing) for stream in (sys.stdout, sys.stderr)]
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors="backslashreplace")
        out, err = streams
        with redirect_stdout(cast(TextIO, out)), redirect_stderr(cast(TextIO, err)):
            yield out
            out.flush()
            err.flush()


@contextmanager
def without_libraries() -> Iterator[None]:
    """Drop what C libraries write to the process's standard error by themselves; what Python writes goes there still.

    Decoders of images do (libjpeg, libpng), and name neither the file nor the frame, as our own sentences do. Nothing
    but the exit status tells of a crash in them then: with ``--verbose`` this is not used.
    """
    stream = sys.stderr
    try:
        is_own = stream.fileno() == STDERR
    except (AttributeError, OSError, ValueError):  # none, or one that is no file
        is_own = False
    if not is_own:
        yield
        return
    stream.flush()
    kept = os.dup(STDERR)
    with (
        open(
            kept, "w", encoding=stream.encoding or "utf-8", errors="backslashreplace", buffering=1, closefd=False
        ) as text,
        open(os.devnull, "wb") as nothing,
    ):
        own = Lenient(text)
        os.dup2(nothing.fileno(), STDERR)
        try:
            with redirect_stderr(cast(TextIO, own)):
                yield
        finally:
            own.end()
            os.dup2(kept, STDERR)
    os.close(kept)
