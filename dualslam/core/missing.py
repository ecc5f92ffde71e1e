"""A source that is not there. Nothing that reads sources is imported, so that a mistyped path is answered at once."""

from __future__ import annotations

from pathlib import Path

from dualslam.core.errors import InputError


def check_exists(source: Path) -> None:
    """Refuse a path at which there is nothing.

    Raises `InputError`.
    """
    if not source.exists():
        raise InputError(
            f"{source} does not exist; give a sequence folder, a video file, the number of a webcam or the "
            "address of a stream."
        )
