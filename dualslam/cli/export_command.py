"""`dualslam export`: the map of a run for other programs."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from dualslam.cli.outputs import check_free
from dualslam.cli.view_command import save_recording
from dualslam.core.errors import DualSlamError, InputError, OutputError
from dualslam.core.types import FloatArray, IntArray
from dualslam.export.exported_map import ExportedMap, flatten, read_stored
from dualslam.export.formats import FORMATS
from dualslam.export.images import with_images
from dualslam.export.metric import by_distance
from dualslam.io.atomic import write_text
from dualslam.io.map_store import StoredMap
from dualslam.io.metric_scale import read_scale
from dualslam.io.run_folder import TRAJECTORY, TRAJECTORY_KITTI
from dualslam.io.run_reading import read_numbers
from dualslam.io.trajectory_files import read_kitti, read_text, read_tum, write_tum
from dualslam.run.sources import open_images_of_run

TRAJECTORIES = {"tum": TRAJECTORY, "kitti": TRAJECTORY_KITTI}
"""Formats of which a run folder has the file already."""
RECORDING = "rerun"
"""Of the run, not of its map alone: what `dualslam view` shows."""


def execute(args: argparse.Namespace) -> int:
    """Write the map of a run in another format."""
    with _folder_for(args):
        return _execute(args)


def _execute(args: argparse.Namespace) -> int:
    if args.to == RECORDING:
        return _write_recording(args)
    if args.to in TRAJECTORIES:
        return _copy_trajectory(args)
    stored = read_stored(args.run)
    numbers = read_numbers(args.run)
    exported = flatten(stored)
    metres = read_scale(args.run)
    if args.distance is not None:
        metres = by_distance(exported, numbers, *args.distance).metres_per_unit
    if metres is not None:
        exported = exported.scaled(metres)
    chosen = FORMATS[args.to]
    all_keyframes = exported.frame
    if args.images is not None:
        exported = _with_images(args, stored, exported, numbers)
    chosen.write(exported, args.out)
    if not args.quiet:
        errors = exported.reprojection_errors_px()
        print(
            f"{len(exported.frame)} views, {len(exported.xyz)} points, {len(exported.view)} observations, "
            f"in {_unit(metres)}, mean reprojection error {np.nanmean(errors):.3f} px; {args.to} in {args.out}",
            flush=True,
        )
        _tell_left_out(np.setdiff1d(all_keyframes, exported.frame), min(numbers.values(), default=0))
    return 0


def _tell_left_out(keyframes: IntArray, first: int) -> None:
    """Say how many keyframes have no image and are not exported; `first`: the number of the run's first frame."""
    n_saved = int((keyframes < first).sum())
    for n, whose in ((n_saved, "the saved map"), (len(keyframes) - n_saved, "the run")):
        if n:
            print(f"{n} keyframes of {whose} have no image in --images, and were left out", flush=True)


@contextmanager
def _folder_for(args: argparse.Namespace) -> Iterator[None]:
    """Refuse what must not be written to, and make the folder; an export that is refused leaves none behind."""
    is_folder = args.to in FORMATS and FORMATS[args.to].is_folder
    if is_folder and args.out.exists():
        if not args.out.is_dir():
            raise OutputError(f"{args.out} is a file, and {args.to} needs a folder; name another with --out.")
        if any(args.out.iterdir()) and not args.overwrite:
            raise OutputError(f"{args.out} is there already; name another with --out, or give --overwrite.")
    if not is_folder:
        if args.out.is_dir():
            raise OutputError(f"{args.out} is a folder, and {args.to} is one file; name another with --out.")
        check_free(args.out, args.overwrite, "another with --out")
    folder: Path = args.out if is_folder else args.out.parent
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        problem = error.strerror or error
        raise OutputError(f"{args.out} cannot be written: {problem}; name another with --out.") from error
    try:
        yield
    except DualSlamError:
        with suppress(OSError):  # there is something in one of them
            for path in made:
                path.rmdir()
        raise


def _copy_trajectory(args: argparse.Namespace) -> int:
    if args.images is not None or args.distance is not None:
        raise InputError(f"--images and --distance do not go with --to {args.to}, which copies the run's trajectory.")
    source = args.run / TRAJECTORIES[args.to]
    if not source.is_file():
        raise InputError(f"{args.run} has no {source.name}; give a run folder.")
    text = read_text(source)
    if not text.strip():
        raise InputError(f"{args.run} has no trajectory to export: no frame was posed.")
    metres = read_scale(args.run)
    if metres is None:
        write_text(args.out, text)
    elif args.to == "tum":
        trajectory = read_tum(source)
        write_tum(args.out, replace(trajectory, T_world_cam=_in_metres(trajectory.T_world_cam, metres)))
    else:
        rows = [" ".join(f"{x:.9g}" for x in T[:3].ravel()) for T in _in_metres(read_kitti(source), metres)]
        write_text(args.out, "".join(f"{row}\n" for row in rows))
    if not args.quiet:
        print(f"trajectory, in {_unit(metres)}, in {args.out}", flush=True)
    return 0


def _write_recording(args: argparse.Namespace) -> int:
    if args.images is not None or args.distance is not None:
        raise InputError(f"--images and --distance do not go with --to {args.to}, which records the run as it was.")
    save_recording(args.run, args.out, args.quiet)
    return 0


def _unit(metres: float | None) -> str:
    return "the map's unit" if metres is None else "metres"


def _in_metres(T_world_cam: FloatArray, metres: float) -> FloatArray:
    T = np.array(T_world_cam)
    T[:, :3, 3] *= metres
    return T


def _with_images(
    args: argparse.Namespace, stored: StoredMap, exported: ExportedMap, numbers: Mapping[int, int]
) -> ExportedMap:
    assert stored.camera is not None
    camera = stored.camera
    source = open_images_of_run(args.images, exported.size_px)
    has_images = FORMATS[args.to].has_images
    return with_images(exported, camera, source, numbers, args.out if has_images else None)
