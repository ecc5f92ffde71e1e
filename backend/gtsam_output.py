"""GTSAM's own printing: some of its factors always write to the process's standard output."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

STDOUT = 1


@contextmanager
def without_gtsam_output() -> Iterator[None]:
    """Drop what is written to standard output by the C++ code called inside.

    For nothing but calls into GTSAM: they hold the interpreter's lock, so that no other thread prints meanwhile.
    """
    try:
        kept = os.dup(STDOUT)
    except OSError:  # a process without standard output has nothing to hide
        yield
        return
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), STDOUT)
            try:
                yield
            finally:
                os.dup2(kept, STDOUT)
    finally:
        os.close(kept)
