"""`dualslam scale`: tells a map how long its unit is, so that exports are in metres."""

from __future__ import annotations

import argparse
from contextlib import suppress

from dualslam.core.errors import InputError
from dualslam.io.colours import load_pictures
from dualslam.io.export.exported_map import flatten, read_stored, with_frames
from dualslam.io.export.metric import MetricScale, by_distance, by_height, by_marker, read_scale, write_scale
from dualslam.io.run_folder import MAP
from dualslam.io.run_reading import read_numbers, read_summary
from dualslam.run.sources import open_images_of_run

NOTABLE = 0.05
"""Change of a scale that is reported: a height and a marker are right to 2 % each (docs/exports.md)."""


def execute(args: argparse.Namespace) -> int:
    """Work out metres per unit of a run's map, and keep it in its run folder."""
    stored = read_stored(args.run)
    exported = flatten(stored)
    numbers = read_numbers(args.run)
    if args.images is not None and args.marker is None:
        raise InputError("--images goes with --marker: the others need none.")
    scale: MetricScale
    if args.distance is not None:
        scale = by_distance(with_frames(exported, stored, numbers.values()), numbers, *args.distance)
    elif args.height is not None:
        scale = by_height(exported, args.height)
    else:
        if args.images is None:
            raise InputError("--marker looks for markers in the run's images: name what it was made of with --images.")
        assert stored.camera is not None
        topic, pictures = read_summary(args.run).get("topic"), load_pictures(args.run / MAP)
        source = open_images_of_run(args.images, exported.size_px, topic, pictures)
        scale = by_marker(exported, stored.camera, source, numbers, args.marker, args.dictionary)
    before: float | None = None
    with suppress(InputError):  # damaged: to scale again is what mends it
        before = read_scale(args.run)
    write_scale(args.run, scale.metres_per_unit, scale.sigma_rel, scale.words)
    if not args.quiet:
        how_sure = "" if scale.sigma_rel is None else f" (sigma {100 * scale.sigma_rel:.2g} %)"
        print(f"a unit of the map is {scale.metres_per_unit:.5g} m{how_sure}: {scale.words}", flush=True)
        if before is not None and abs(scale.metres_per_unit / before - 1) > NOTABLE:
            times = scale.metres_per_unit / before
            print(f"that is {times:.3g} times what it was ({before:.5g} m): exports made before do not go with it")
    return 0
