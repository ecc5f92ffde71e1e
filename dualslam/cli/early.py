"""Checks before anything heavy is imported: a mistyped field or path is answered at once."""

from __future__ import annotations

import argparse
from pathlib import Path

from dualslam.cli.configuration import config_of
from dualslam.core.missing import check_exists


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
