"""From the options of the command line to one configuration; a mistyped field or path is answered at once."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dualslam.core.config import strict_yaml
from dualslam.core.config.files import Override, load_config, load_run_config
from dualslam.core.config.settings import Config
from dualslam.core.errors import ConfigError, InputError, OutputError, check_exists
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
    def option(name: str, *path: str, value: Callable[[Any], Any] = lambda given: given) -> list[Override]:
        given = getattr(args, name, None)
        if given is None or given is False:
            return []
        words = f"--{name.replace('_', '-')}{'' if given is True else f' {given}'}"
        return [Override(path, value(given), words)]

    workers = "recovery", "workers"
    return [
        *option("realtime", *workers, value=lambda _: 1),  # before --set, which may say otherwise
        *map(Override.parse, args.set),
        *option("frontend", "frontend", "name"),
        *option("seed", "seed"),
        *(option("inline", *workers, value=lambda _: 0) or option("workers", *workers)),
        *option("mask", "camera", "mask", value=str),
        *option("corrupt", "corruptions", value=_read_corruptions),
        *option("no_recovery", "recovery", "enabled", value=lambda _: False),
    ]


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
