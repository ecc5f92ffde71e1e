"""Standard output and error of a command: what they cannot take costs nothing that is computed."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from typing import Any, TextIO, cast


class Lenient:
    """A text stream that drops what cannot be written, once its reader has gone or its disk is full.

    Attributes
    ----------
    problem : OSError or None
        What was wrong first.
    """

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
