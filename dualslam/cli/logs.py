"""The log on stderr. Warnings wait until the input has proved good, so that bad input is answered by one sentence."""

from __future__ import annotations

import logging
import os
import sys
from logging.handlers import MemoryHandler

CLEARED = "\r\x1b[K"
"""Takes what a terminal shows of its last line away: how far a run is, and no message, stands there."""
_CAPACITY = 1000
_held: MemoryHandler | None = None


def set_up(verbose: int, quiet: bool) -> None:
    """Log to stderr: warnings; with one `verbose` what happens, with two all details; `quiet`: errors alone."""
    global _held
    level = logging.ERROR if quiet else (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
    stream = logging.StreamHandler(sys.stderr)
    stream.setFormatter(
        logging.Formatter(f"{CLEARED if sys.stderr.isatty() else ''}%(levelname)s %(name)s: %(message)s")
    )
    _held = None if verbose else MemoryHandler(_CAPACITY, logging.CRITICAL, stream, flushOnClose=False)
    logging.basicConfig(level=level, handlers=[_held or stream], force=True)
    logging.captureWarnings(True)
    if not verbose:  # of an overflow, or of what a package gives up: nothing that a user could act upon
        logging.getLogger("py.warnings").setLevel(logging.ERROR)
    if verbose < 2:
        logging.getLogger("matplotlib").setLevel(logging.WARNING)
        # OpenCV writes to stderr by itself, and so does its decoder of videos; they read this when they begin.
        os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


def release() -> None:
    """Show what was held back, and from now on everything at once."""
    global _held
    if _held is not None:
        _held.flush()
        _held.flushLevel = logging.NOTSET
        _held = None


def discard() -> None:
    """Forget what was held back: the error that follows says what matters."""
    if _held is not None:
        _held.buffer.clear()
