"""`dualslam run`: a source of frames in, a run folder out."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dualslam.build import check_config, fault_of_frontend
from dualslam.build.parts import measurement_sources
from dualslam.cli import logs
from dualslam.cli.batch import run_all
from dualslam.cli.configuration import config_of, naming_source
from dualslam.cli.console import final_line, no_map_line, progress, stage_table, verdict_line, waiting
from dualslam.core import exit_status
from dualslam.core.camera.focal import FocalSearch
from dualslam.core.config.settings import Config
from dualslam.core.errors import DualSlamError, InputError, NoCalibrationError
from dualslam.io.atomic import write_text
from dualslam.io.reduced import MAX_SIDE_PX
from dualslam.io.run_folder import MAP_PAGE, REPORT
from dualslam.io.sequence import RecordedSequence
from dualslam.run.before import open_without_calibration, with_camera_found, with_camera_of_map, with_prior
from dualslam.run.measuring import read_rows
from dualslam.run.session import Outcome, Watchers, check_out, run_to_folder
from dualslam.run.sources import open_source
from dualslam.viewer.live import LiveView

log = logging.getLogger(__name__)

PAGE = "live_map.html"
"""In the run folder: the map as it stood when a person saved it in the live view."""


def execute(args: argparse.Namespace) -> int:
    """Run, and tell the outcome in one line."""
    if args.localise and args.map is None:
        raise InputError("--localise finds poses in a saved map: name its run folder with --map.")
    config = config_of(args)
    with naming_source(args):
        check_config(config)
    with naming_frontend(config):
        return _run(args, config) if len(args.sources) == 1 else run_all(args, lambda one: _run(one, config))


def _run(args: argparse.Namespace, config: Config) -> int:
    (source,) = args.sources
    check_out(
        args.out, overwrite=args.overwrite, saved_map=args.map, replay=args.replay
    )  # before a search for the camera
    selection = {
        "start": args.start,
        "stride": args.stride,
        "max_frames": args.max_frames,
        "reverse": args.reverse,
        "rate_hz": args.rate,
        "time_unit": args.time_unit,
        "topic": args.topic,
        "max_side_px": None if args.full_size else MAX_SIDE_PX,
    }
    focal: FocalSearch | None = None
    has_camera = True
    with waiting("opening the source; estimating its camera if none is given", args.quiet):
        try:
            sequence = open_source(source, camera_file=args.camera, fov_degrees=args.fov, **selection)
        except NoCalibrationError:
            has_camera = False
            logs.discard()  # it is opened again
            recorded = open_without_calibration(source, **selection)
            of_map = None if args.map is None else with_camera_of_map(args.map, recorded)
            if of_map is not None:
                sequence = of_map
            else:
                sequence, focal = with_camera_found(config, recorded)
                config = with_prior(config, focal)
    if not has_camera:
        _tell(focal, args.quiet)
    times_s = sequence.frame_timestamps if isinstance(sequence, RecordedSequence) else None
    measurements = measurement_sources(read_rows(args.measurements, args.sigma, args.clock_offset, times_s))
    logs.release()
    with live_view(args) as live:
        with progress(sequence, args.quiet) as shown:
            outcome = run_to_folder(
                config,
                sequence,
                args.out,
                overwrite=args.overwrite,
                realtime=args.realtime,
                saved_map=args.map,
                localise=args.localise,
                focal=focal,
                replay=args.replay,
                decisions=args.decisions,
                measurements=measurements,
                watcher=Watchers([each for each in (live, shown) if each is not None]),
            )
        status = conclude(outcome, args)
        if outcome.has_map and not args.quiet:
            print(f"open {outcome.out / REPORT} and {outcome.out / MAP_PAGE}", flush=True)
        stay_open(live)
    may_go_on = outcome.report.interrupted and outcome.has_map and not args.reverse and not args.localise
    if isinstance(sequence, RecordedSequence) and may_go_on and not args.quiet:
        following = outcome.system.numbers.index_of(max(outcome.system.rows)) + args.stride
        if following <= sequence.source_indices[-1]:
            print(f"to go on: the same with --start {following}, --map {outcome.out} and another --out", flush=True)
    return status


@contextmanager
def naming_frontend(config: Config) -> Iterator[None]:
    """Say of an exception that a front end of another package has raised that it did; it is no bug of ours."""
    try:
        yield
    except DualSlamError:
        raise
    except Exception as error:
        fault = fault_of_frontend(error, config)
        if fault is None:
            raise
        log.info("what the front end raised", exc_info=error)
        for note in getattr(error, "__notes__", ()):
            fault.add_note(note)
        raise fault from error


@contextmanager
def live_view(args: argparse.Namespace) -> Iterator[LiveView | None]:
    """Open the view that --live asks for."""
    if args.live is None:
        yield None
        return
    live = LiveView(args.live)
    live.on_save = lambda page: write_text(Path(args.out) / PAGE, page)
    print(f"live view: {live.url}", flush=True)
    try:
        yield live
    finally:
        live.close()


def stay_open(live: LiveView | None) -> None:
    """Keep the live view after the run, where a person sits, until they end it."""
    if live is not None and sys.stdin is not None and sys.stdin.isatty() and live.alive:
        print(f"the live view stays at {live.url} until you press Ctrl-C", flush=True)
        live.wait()


def _tell(focal: FocalSearch | None, quiet: bool) -> None:
    if quiet:
        return
    if focal is None:
        print("no calibration: taken to be by the camera of the saved map; --fov or --camera know better", flush=True)
    else:
        low, high = focal.fov_range_deg
        print(
            f"no calibration: the frames show a field of view of {focal.fov_deg:.0f} degrees ({low:.0f} to {high:.0f}, "
            f"to 90 %){', and a lens that bends' if focal.lens else ''}; self-calibration goes on from there, --fov or "
            "--camera know better",
            flush=True,
        )


def conclude(outcome: Outcome, args: argparse.Namespace) -> int:
    """Print what a run found, and return the exit status."""
    if args.profile:
        print(stage_table(outcome))
    if (replay := outcome.summary.get("replay")) is not None and not args.quiet:
        same = "the same trajectory, bit for bit" if replay["same_trajectory"] else "another trajectory"
        apart = "" if replay["departure"] is None else f"; it comes apart at {replay['departure']}"
        print(f"replay of {replay['run']}: {same}{apart}", flush=True)
    if not args.quiet:
        print(final_line(outcome), flush=True)
        if outcome.has_map:
            print(verdict_line(outcome), flush=True)
    elif not outcome.has_map and not outcome.report.interrupted:
        print(f"dualslam: {no_map_line(outcome)}", file=sys.stderr)
    if outcome.report.interrupted:
        return exit_status.INTERRUPTED
    return exit_status.DONE if outcome.has_map else exit_status.FAILED
