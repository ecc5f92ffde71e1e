"""`dualslam export`: the map of a run for other programs."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dualslam.atlas.stored_map import StoredMap
from dualslam.cli.configuration import check_free
from dualslam.cli.view_command import save_recording
from dualslam.core.errors import DualSlamError, InputError, OutputError
from dualslam.core.geometry import se3
from dualslam.core.types import IntArray
from dualslam.io.atomic import write_text
from dualslam.io.colours import keyframe_indices, landmark_colours, load_pictures
from dualslam.io.export.exported_map import ExportedMap, flatten, read_stored, with_frames
from dualslam.io.export.formats import FORMATS
from dualslam.io.export.images import mask_of, undistorted, with_images
from dualslam.io.export.mcap import write_mcap
from dualslam.io.export.metric import by_distance, read_scale
from dualslam.io.run_folder import MAP, TRAJECTORY, TRAJECTORY_KITTI
from dualslam.io.run_reading import read_numbers, read_summary
from dualslam.io.sequence import RecordedSequence
from dualslam.io.trajectory_files import read_kitti, read_text, read_tum, write_tum
from dualslam.run.sources import SYNTHETIC, WorldSequence, open_images_of_run

TRAJECTORIES = {"tum": TRAJECTORY, "kitti": TRAJECTORY_KITTI}
"""Formats of which a run folder has the file already."""
RECORDING = "rerun"
"""Of the run, not of its map alone: what `dualslam view` shows."""
MESSAGES = "mcap"
"""The poses of all frames, the map, and the views' images, in one file."""


def execute(args: argparse.Namespace) -> int:
    """Write the map of a run in another format."""
    with _folder_for(args):
        return _execute(args)


def _execute(args: argparse.Namespace) -> int:
    if args.every is not None and not (args.to == MESSAGES or (args.to in FORMATS and FORMATS[args.to].has_images)):
        raise InputError(f"--every goes with --to colmap, nerfstudio and mcap: {args.to} has no images.")
    if args.to == RECORDING:
        return _write_recording(args)
    if args.to in TRAJECTORIES:
        return _copy_trajectory(args)
    stored = read_stored(args.run)
    numbers = read_numbers(args.run)
    has_colours = args.to == MESSAGES or FORMATS[args.to].has_colours
    source = _source(args, stored) if has_colours else None
    if source is not None and not stored.colours:
        frames = source.in_colour(keyframe_indices(stored.atlas, numbers))
        stored = replace(stored, colours=landmark_colours(stored.atlas, frames, numbers, {}))
    exported = flatten(stored)
    metres = read_scale(args.run)
    if args.distance is not None:
        posed = with_frames(exported, stored, numbers.values())
        metres = by_distance(posed, numbers, *args.distance).metres_per_unit
    if args.every is not None:
        exported = with_frames(exported, stored, list(numbers.values())[:: args.every])
    if metres is not None:
        exported = exported.scaled(metres)
    if args.to == MESSAGES:
        posed = with_frames(flatten(stored), stored, numbers.values()).scaled(metres or 1.0)
        return _write_messages(args, exported, posed, stored, source, numbers, metres)
    chosen = FORMATS[args.to]
    all_views = exported.frame
    if source is not None and chosen.has_images:
        assert stored.camera is not None
        images = source.in_colour(exported.rows_by_index(numbers))
        exported = with_images(exported, stored.camera, images, numbers, args.out, mask_of(args.run))
    chosen.write(exported, args.out)
    if not args.quiet:
        errors = exported.reprojection_errors_px()
        print(
            f"{len(exported.frame)} views, {len(exported.xyz)} points, {len(exported.view)} observations, "
            f"in {_unit(metres)}, mean reprojection error {np.nanmean(errors):.3f} px; {args.to} in {args.out}",
            flush=True,
        )
        _tell_left_out(np.setdiff1d(all_views, exported.frame), min(numbers.values(), default=0))
        if source is not None and chosen.next_command:
            print(f"next, {chosen.next_command.format(out=args.out.absolute())}", flush=True)
    return 0


def _write_messages(
    args: argparse.Namespace,
    exported: ExportedMap,
    posed: ExportedMap,
    stored: StoredMap,
    source: RecordedSequence | WorldSequence | None,
    numbers: Mapping[int, int],
    metres: float | None,
) -> int:
    """Write the poses of all frames, and the images of the exported views."""
    rows, wanted = posed.rows_by_index(numbers), exported.rows_by_index(numbers)
    by_time = sorted(rows.values(), key=lambda v: float(posed.timestamp_s[v]))
    n_images = 0

    def images() -> Iterator[tuple[int, NDArray[np.uint8]]]:
        nonlocal n_images
        assert stored.camera is not None
        frames = () if source is None else source.in_colour(wanted)
        for v, image, _ in undistorted(posed, stored.camera, frames, numbers):
            n_images += 1
            yield v, image

    write_mcap(posed, np.array(by_time, np.int64), images(), args.out)
    if not args.quiet:
        found = f"{len(by_time)} poses, {len(posed.xyz)} points, {n_images} images"
        print(f"{found}, in {_unit(metres)}; {args.to} in {args.out}", flush=True)
    return 0


def _source(args: argparse.Namespace, stored: StoredMap) -> RecordedSequence | WorldSequence | None:
    """Open what the run was made of, for images and colours; None, and a sentence, where it is not there any more."""
    remembered = read_summary(args.run).get("source")
    assert stored.camera is not None
    if args.images is None and not (
        remembered and (str(remembered).startswith(SYNTHETIC) or Path(remembered).exists())
    ):
        if (args.to == MESSAGES or FORMATS[args.to].has_images) and not args.quiet:
            print(f"no images: {_where_it_was(remembered)}; name it with --images", flush=True)
        return None
    pictures = load_pictures(args.run / MAP)
    return open_images_of_run(
        str(args.images or remembered), stored.camera.size_px, read_summary(args.run).get("topic"), pictures
    )


def _where_it_was(remembered: str | None) -> str:
    return f"{remembered} is not there any more" if remembered else "the run does not know its source"


def _tell_left_out(views: IntArray, first: int) -> None:
    """Say how many views have no image and are not exported; `first`: the number of the run's first frame."""
    n_saved = int((views < first).sum())
    for n, whose in ((n_saved, "the saved map"), (len(views) - n_saved, "the run")):
        if n:
            print(f"{n} views of {whose} have no image in --images, and were left out", flush=True)


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
        write_tum(args.out, replace(trajectory, T_world_cam=se3.scaled(trajectory.T_world_cam, metres)))
    else:
        rows = [" ".join(f"{x:.9g}" for x in T[:3].ravel()) for T in se3.scaled(read_kitti(source), metres)]
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
