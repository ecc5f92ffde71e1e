"""Checks before any work: a mistyped field or path, or an output in the way, is answered at once."""

from __future__ import annotations

import argparse
from pathlib import Path

from dualslam.cli.configuration import config_of
from dualslam.core.errors import OutputError, check_exists


def check(args: argparse.Namespace) -> None:
    """Refuse a configuration that names what does not exist, and a source that is not there.

    Raises `ConfigError`, `InputError`.
    """
    if hasattr(args, "set"):
        config_of(args)
    for source in getattr(args, "sources", ()):
        # A number is a webcam; with a colon it is a stream or a synthetic world.
        if ":" not in source and not source.isdigit():
            check_exists(Path(source))


def check_free(file: Path, overwrite: bool, instead: str) -> None:
    """Refuse a file that is there already, unless it may be replaced.

    - `overwrite`: whether `--overwrite` was given.
    - `instead`: what to name in its place, and by which option: "another with --out".

    Raises `OutputError`.
    """
    if file.exists() and not overwrite:
        raise OutputError(f"{file} is there already; name {instead}, or give --overwrite.")
