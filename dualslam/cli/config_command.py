"""`dualslam config`: the resolved configuration, explained."""

from __future__ import annotations

import argparse

from dualslam.cli.configuration import config_of
from dualslam.core.config_io import dump_config


def execute(args: argparse.Namespace) -> int:
    """Print the configuration as YAML."""
    print(dump_config(config_of(args)), end="", flush=True)
    return 0
