"""`dualslam render`: a synthetic world as a sequence folder."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from dualslam.core.errors import OutputError
from dualslam.lab.synthetic import render_to_folder
from dualslam.run.sources import make_world, read_script

_TEXTS = ("times.txt", "calib.txt", "groundtruth_tum.txt", "SOURCE.md")
_IMAGE = re.compile(r"\d{6}\.(png|jpg)")


def execute(args: argparse.Namespace) -> int:
    """Render, and say what was written."""
    script = read_script(args.events) if args.events is not None else ()
    world = make_world(args.world, args.frames, args.seed, script)
    if args.overwrite:
        _remove_rendering(args.out)
    folder = render_to_folder(world, args.out)
    if not args.quiet:
        print(f"{len(world)} frames of {world.name} in {folder}", flush=True)
    return 0


def _remove_rendering(folder: Path) -> None:
    """Remove what an earlier `render` wrote, and nothing else: not from a folder that it did not write."""
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    try:
        ours = "Rendered by `dualslam.lab.synthetic`" in (folder / "SOURCE.md").read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        ours = False
    if not ours:
        raise OutputError(f"{folder} was not written by dualslam render, so nothing is removed; choose another folder.")
    images = folder / "images"
    try:
        for file in images.iterdir() if images.is_dir() else ():
            if _IMAGE.fullmatch(file.name):
                file.unlink()
        for name in _TEXTS:
            (folder / name).unlink(missing_ok=True)
        if images.is_dir() and not any(images.iterdir()):
            images.rmdir()
    except OSError as error:
        raise OutputError(f"{folder} cannot be overwritten: {error.strerror or error}.") from error
