"""`dualslam config`: the resolved configuration, explained."""

from __future__ import annotations

import argparse

from dualslam.build import check_config
from dualslam.cli.configuration import config_of, naming_source
from dualslam.core.config.files import dump_config


def execute(args: argparse.Namespace) -> int:
    """Print the configuration as YAML, if `run` would take it."""
    config = config_of(args)
    with naming_source(args):
        check_config(config)
    print(dump_config(config), end="", flush=True)
    return 0
