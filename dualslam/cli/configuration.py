"""From the options of the command line to one configuration."""

from __future__ import annotations

import argparse

from dualslam.core.config import Config
from dualslam.core.config_io import Override, load_config


def config_of(args: argparse.Namespace) -> Config:
    """Resolve ``--config``, ``--set`` and the options that stand for single fields, the latter last.

    Raises
    ------
    ConfigError
    """
    overrides = [Override.parse(text) for text in args.set]
    if args.frontend is not None:
        overrides.append(Override(("frontend", "name"), args.frontend, f"--frontend {args.frontend}"))
    if args.seed is not None:
        overrides.append(Override(("seed",), args.seed, f"--seed {args.seed}"))
    # A configuration without that section has no recovery to switch off.
    if args.no_recovery and "recovery" in Config.model_fields:
        overrides.append(Override(("recovery", "enabled"), False, "--no-recovery"))
    return load_config(args.config, overrides)
