"""`dualslam measure`: puts the map of a finished run into the frame of measurements from outside."""

from __future__ import annotations

import argparse

import numpy as np

from dualslam.build.parts import measurement_sources, metric_parts
from dualslam.core.config.files import load_run_config
from dualslam.core.errors import InputError
from dualslam.io.export.exported_map import read_stored
from dualslam.io.metric_files import TRAJECTORY_METRIC
from dualslam.io.run_folder import FRAMES, write_summary
from dualslam.io.run_reading import read_frames, read_numbers, read_summary
from dualslam.run.measuring import measure, read_rows, write_measured


def execute(args: argparse.Namespace) -> int:
    """Solve the joint graph, write the metric files, and tell the outcome in one line."""
    times_s = np.array([row.timestamp_s for row in read_frames(args.run / FRAMES)])
    sources = measurement_sources(read_rows(args.measurements, args.sigma, args.clock_offset, times_s))
    stored = read_stored(args.run)
    parts = metric_parts(load_run_config(args.run))
    measured = measure(stored.atlas, stored.poses, stored.main, sources, parts)
    if measured.undone:
        pairs = ", ".join(f"{link.a} and {link.b}" for link in measured.undone)
        raise InputError(
            f"the measurements contradict the join of submaps {pairs}; run again with --measurements, which undoes it."
        )
    numbers = read_numbers(args.run)
    write_measured(args.run, measured, {number: index for index, number in numbers.items()})
    write_summary(args.run, read_summary(args.run) | {"measurements": measured.summary()})
    if not args.quiet:
        print(f"{measured.line()}; written: {args.run / TRAJECTORY_METRIC}", flush=True)
    return 0
