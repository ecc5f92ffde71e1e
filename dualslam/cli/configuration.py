"""From the options of the command line to one configuration."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dualslam.core.config import strict_yaml
from dualslam.core.config.files import Override, load_config, load_run_config
from dualslam.core.config.settings import Config
from dualslam.core.errors import ConfigError, InputError
from dualslam.core.schedule import SCHEDULE, Recorded


def config_of(args: argparse.Namespace) -> Config:
    """Resolve ``--config``, ``--set``, ``--corrupt`` and the options that stand for single fields, the latter last.

    The files are read once, as they may be pipes: `args` keeps what is found, as `resolved` and `overrides`.

    Raises `ConfigError`.
    """
    if getattr(args, "resolved", None) is None:
        take_selection(args)
        args.overrides = _overrides(args)
        replay: Path | None = getattr(args, "replay", None)
        if args.config is None and replay is not None:
            args.resolved = load_run_config(replay, args.overrides)
        else:
            args.resolved = load_config(args.config, args.overrides)
    config: Config = args.resolved
    return config


def take_selection(args: argparse.Namespace) -> None:
    """Take the frames of the run that `--replay` repeats, where the options select none.

    Raises `InputError` if there is no such run, or the options say that it is not repeated in one process.
    """
    if getattr(args, "replay", None) is None:
        return
    if args.realtime or args.inline or args.workers is not None:
        raise InputError("--replay repeats a run in one process: leave out --realtime, --inline and --workers.")
    selection = Recorded.read(args.replay / SCHEDULE).header.get("selection")
    if selection and (args.start, args.stride, args.max_frames, args.reverse) == (0, 1, None, False):
        for name in ("start", "stride", "max_frames", "reverse"):
            setattr(args, name, selection[name])


def _overrides(args: argparse.Namespace) -> list[Override]:
    overrides = []
    if getattr(args, "realtime", False):  # before --set, which may say otherwise
        overrides.append(Override(("recovery", "workers"), 1, "--realtime"))
    overrides += [Override.parse(text) for text in args.set]
    if args.frontend is not None:
        overrides.append(Override(("frontend", "name"), args.frontend, f"--frontend {args.frontend}"))
    if args.seed is not None:
        overrides.append(Override(("seed",), args.seed, f"--seed {args.seed}"))
    if getattr(args, "inline", False):
        overrides.append(Override(("recovery", "workers"), 0, "--inline"))
    elif getattr(args, "workers", None) is not None:
        overrides.append(Override(("recovery", "workers"), args.workers, f"--workers {args.workers}"))
    mask: Path | None = getattr(args, "mask", None)
    if mask is not None:
        overrides.append(Override(("camera", "mask"), str(mask), f"--mask {mask}"))
    corrupt: Path | None = getattr(args, "corrupt", None)
    if corrupt is not None:
        overrides.append(Override(("corruptions",), _read_corruptions(corrupt), f"--corrupt {corrupt}"))
    if getattr(args, "no_recovery", False):
        overrides.append(Override(("recovery", "enabled"), False, "--no-recovery"))
    return overrides


@contextmanager
def naming_source(args: argparse.Namespace) -> Iterator[None]:
    """Say of a mistake in a value of the configuration where it stands: in which option, or which file."""
    try:
        yield
    except ConfigError as error:
        setting = (o.source for o in reversed(args.overrides) if error.field and o.sets(error.field))
        source = next(setting, args.config)
        raise ConfigError(str(error) if source is None else f"{source}: {error}") from error


def _read_corruptions(path: Path) -> list[Any]:
    items = strict_yaml.read(path, "the file", f"--corrupt {path}")
    if not isinstance(items, list):
        raise ConfigError(
            f"--corrupt {path}: corruptions are a list, such as - {{kind: blackout, start: 100, length: 10}}"
        )
    return items
