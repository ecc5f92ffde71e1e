"""Checks of the files that a command is about to write."""

from __future__ import annotations

from pathlib import Path

from dualslam.core.errors import OutputError


def check_free(file: Path, overwrite: bool, instead: str) -> None:
    """Refuse a file that is there already, unless it may be replaced.

    - `overwrite`: whether `--overwrite` was given.
    - `instead`: what to name in its place, and by which option: "another with --out".

    Raises `OutputError`.
    """
    if file.exists() and not overwrite:
        raise OutputError(f"{file} is there already; name {instead}, or give --overwrite.")
