"""`dualslam merge`: joins the maps of two runs that saw the same places."""

from __future__ import annotations

import argparse

import numpy as np

from dualslam.build.parts import measurement_sources
from dualslam.core.events import EventKind
from dualslam.core.metric_problem import MeasurementSource
from dualslam.io.run_folder import FRAMES
from dualslam.io.run_reading import read_frames
from dualslam.run.measuring import read_rows
from dualslam.run.merging import merge_runs


def execute(args: argparse.Namespace) -> int:
    """Join the maps, write a run folder, and tell the outcome in one line."""

    def measurements(shift_s: float) -> list[MeasurementSource]:
        found, origin = [], None
        for run, paths, shift in ((args.run_a, args.measurements, 0.0), (args.run_b, args.measurements_b, shift_s)):
            times_s = np.array([row.timestamp_s for row in read_frames(run / FRAMES)])
            found += read_rows(paths, args.sigma, args.clock_offset + shift, times_s, origin)
            origin = next((rows.origin for rows in found if rows.origin is not None), None)
        return measurement_sources(found)

    system = merge_runs(args.run_a, args.run_b, args.out, overwrite=args.overwrite, measurements=measurements)
    if not args.quiet:
        n = len(system.events.of_kind(EventKind.MERGED, EventKind.LOOP_CLOSED))
        print(f"joined by {n} {'place' if n == 1 else 'places'}; written: {args.out}", flush=True)
    return 0
