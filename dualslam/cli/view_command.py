"""`dualslam view`: a finished run in the Rerun viewer, or as a recording for it."""

from __future__ import annotations

import argparse
from pathlib import Path

from dualslam.cli.early import check_free
from dualslam.core.errors import InputError
from dualslam.core.extras import how_to_install
from dualslam.io.atomic import write_bytes
from dualslam.report.run_data import RunData, read_run
from dualslam.viewer.window import has_display, open_viewer


def execute(args: argparse.Namespace) -> int:
    """Write the recording of a run, or open the viewer with it."""
    if args.save is not None:
        check_free(args.save, args.overwrite, "another with --save")
        save_recording(args.run, args.save, args.quiet)
        return 0
    run = read_run(args.run)
    if not has_display():
        raise InputError("there is no display to open a viewer on; write the recording with --save FILE.")
    open_viewer(_record(run))
    return 0


def save_recording(run: Path, out: Path, quiet: bool) -> None:
    """Write the recording of a run."""
    write_bytes(out, _record(read_run(run)))
    if not quiet:
        print(f"recording in {out}; open it with rerun {out}", flush=True)


def _record(run: RunData) -> bytes:
    try:
        from dualslam.viewer.recording import make_recording
    except ImportError as error:
        raise InputError(f"dualslam view needs the Rerun viewer: {how_to_install('view')}.") from error
    return make_recording(run)
