"""Commands, options and their help. Nothing heavy is imported until a command executes."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn, TypeAlias

from dualslam import __version__
from dualslam.run.interrupts import held_back

WORLDS = (
    *("street", "room", "circuit", "eight", "terrace", "ward", "corridors", "posters"),
    *("board", "parked", "takeoff", "standstill", "hover"),
)
EXPORTS = ("bal", "colmap", "g2o", "kitti", "mcap", "nerfstudio", "ply", "rerun", "tum")
DICTIONARIES = (
    *("apriltag_36h11", "apriltag_25h9", "apriltag_16h5"),
    *("aruco_4x4", "aruco_5x5", "aruco_6x6", "aruco_original"),
)
TIME_UNITS = ("s", "ms", "us", "ns")
MAX_PORT = 65535
SHORTEST_M, LONGEST_M = 1e-6, 1e9
"""Of a known length: a mistyped exponent, and nothing that a camera could see, lies outside."""
SOURCE_HELP = (
    "a sequence folder (KITTI, TUM RGB-D, TUM-Mono, EuRoC, ours); a ROS bag or MCAP. A folder of images or a video: "
    "its camera is estimated without --camera or --fov. With one of these: a webcam's number, or the address "
    "of a stream (rtsp://..., http://...). A rendered world: synthetic:street, room, circuit, eight, terrace, ward, "
    "corridors, posters, board, parked, takeoff, standstill, hover, with options as in "
    "synthetic:street,frames=300,seed=1,events=FILE"
)
EXIT_STATUSES = (
    "Exit status: 0 done. 1: no frame has a pose, or an unexpected error. 2: bad usage or bad input. "
    "130: interrupted; all results so far are written."
)


class _Parser(argparse.ArgumentParser):
    """An argument parser that says what is wrong in one sentence, and what may have been meant."""

    _given: Sequence[str] = ()

    def parse_known_args(self, args=None, namespace=None):  # type: ignore[no-untyped-def]
        """Note the words, for the sentence."""
        self._given = list(args or ())
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        prog = self._of_command().prog
        self.exit(2, f"{prog}: {message}{self._meant(message)}; see {prog} --help\n")

    def _meant(self, message: str) -> str:
        wrong, offered, choices = message.partition(" (choose from ")
        if offered:
            near = get_close_matches(wrong.rpartition(": ")[2].strip("'"), re.findall(r"'([^']+)'", choices), n=1)
            return f"; did you mean '{near[0]}'?" if near else ""
        parser = self._of_command()
        options = parser._option_string_actions
        for word in parser._given:
            option = word.partition("=")[0]
            if option.startswith("--") and option not in options and (near := get_close_matches(option, options, n=1)):
                return f"; {option} is no option, did you mean {near[0]}?"
        return ""

    def _of_command(self) -> _Parser:
        """Return the parser of the command that was given, or this one."""
        for action in self._actions:
            if isinstance(action, argparse._SubParsersAction):
                return next((action.choices[word] for word in self._given if word in action.choices), self)
        return self


Commands: TypeAlias = "argparse._SubParsersAction[_Parser]"


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse a command line; the result's `execute` is the function to call with it.

    Raises `SystemExit`: with status 2 and one sentence on stderr where the usage is wrong; with 0 after ``--help`` and
    ``--version``.
    """
    return _build_parser().parse_args(arguments)


def _build_parser() -> _Parser:
    parser = _Parser(
        prog="dualslam",
        description="Monocular SLAM that recovers from tracking failure. "
        "Begin with: dualslam run walk.mp4 --out runs/walk (your video), or: dualslam demo",
        epilog=EXIT_STATUSES,
    )
    parser.add_argument("--version", action="version", version=f"dualslam {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True, parser_class=_Parser)
    for add in (
        *(_add_run, _add_eval, _add_compare, _add_explain, _add_view, _add_export, _add_scale, _add_measure),
        *(_add_merge, _add_render, _add_config, _add_demo, _add_bench),
    ):
        add(commands)
    return parser


def _command(commands: Commands, name: str, help_text: str) -> tuple[_Parser, argparse._ArgumentGroup]:
    parser = commands.add_parser(name, help=help_text, description=help_text, allow_abbrev=False)
    parser.set_defaults(execute=_late(name))
    talk = parser.add_argument_group("messages")
    talk.add_argument("-q", "--quiet", action="store_true", help="print nothing but errors")
    talk.add_argument("-v", "--verbose", action="count", default=0, help="log what happens; twice: every detail")
    return parser, talk


def _late(name: str) -> Callable[[argparse.Namespace], int]:
    """Return a function that imports a command's module when it is called."""

    def execute(args: argparse.Namespace) -> int:
        with held_back():
            early = import_module("dualslam.cli.configuration")
        early.check(args)
        with held_back():
            command = import_module(f"dualslam.cli.{name}_command")
        status: int = command.execute(args)
        return status

    return execute


def _value(
    group: argparse._ActionsContainer,
    name: str,
    metavar: str,
    help_text: str,
    kind: Callable[[str], object] = str,
    **options: Any,
) -> None:
    """Add an option or a positional that takes a value."""
    group.add_argument(name, metavar=metavar, type=kind, help=help_text, **options)


def _flag(group: argparse._ActionsContainer, name: str, help_text: str) -> None:
    group.add_argument(name, action="store_true", help=help_text)


def _add_run(commands: Commands) -> None:
    parser, talk = _command(commands, "run", "Run on a source of frames and write a run folder.")
    several = SOURCE_HELP + ". Several: a run folder for each below DIR, and a table of all"
    _value(parser, "sources", "SOURCE", several, _source, nargs="+")
    _value(parser, "--topic", "NAME", "topic of the images, where SOURCE is a bag of several")
    _add_output(parser)
    _flag(parser, "--decisions", "write decisions.jsonl, which dualslam explain prints")
    _flag(talk, "--profile", "print where the time went, stage by stage")
    _add_configuration(parser)
    _add_selection(parser)
    lab = parser.add_argument_group("failure lab")
    spoilt = "YAML list of corruptions and faults for this run (corruptions), as - {kind: blur, start: 50, length: 9}"
    _value(lab, "--corrupt", "FILE", spoilt, _path)
    images = parser.add_argument_group("camera")
    camera = images.add_mutually_exclusive_group()
    _value(camera, "--camera", "FILE", "calibration, instead of the source's own", _path)
    _value(
        camera, "--fov", "DEGREES", "field of view along the longer side of the images, without a calibration", _angle
    )
    mask = "image whose black pixels show no scene; or a folder with one for each frame (camera.mask)"
    _value(images, "--mask", "FILE", mask, _path)
    _flag(images, "--full-size", "read images of more than 2048 pixels as they are")
    clock = parser.add_argument_group("clock").add_mutually_exclusive_group()
    _value(clock, "--rate", "HZ", "frames a second, instead of the source's own times", _rate)
    clock.add_argument("--time-unit", choices=TIME_UNITS, help="unit of the source's own times; by default seconds")
    _add_measurements(parser)
    saved = parser.add_argument_group("saved map")
    _value(saved, "--map", "DIR", "run folder whose map this run finds its frames in, and extends", _path)
    _flag(saved, "--localise", "find poses in the map of --map, and add nothing to it")
    mode = parser.add_argument_group("mode")
    realtime = "frames come at the source's rate and are dropped when late; otherwise every frame, as fast as it goes"
    _flag(mode, "--realtime", realtime)
    replay = "repeat a run in one process, to the bit, by the schedule in its folder; SOURCE and --map as it had them"
    _value(mode, "--replay", "RUN", replay, _path)
    live = "watch the run in a browser, on a port of this machine (a free one without a number)"
    _value(mode, "--live", "PORT", live, _port, nargs="?", const=0)
    processes = mode.add_mutually_exclusive_group()
    _flag(processes, "--inline", "one process, deterministic: --workers 0, the default")
    workers = "processes for long background work, and one for its graph; --realtime: 1, and one for features"
    _value(processes, "--workers", "N", workers, _count)


def _add_eval(commands: Commands) -> None:
    parser, _ = _command(commands, "eval", "Score a run against ground truth: coverage first, then ATE and RPE.")
    _add_run_folder(parser, "a run folder, or a trajectory in TUM format")
    _value(parser, "sequence", "SEQUENCE", "the sequence with its ground truth", _source)
    _flag(parser, "--keyframes-only", "the error of keyframes, besides all frames'")
    _flag(parser, "--returns", "the sequence ends where it began: an error that needs no ground truth")
    _flag(parser, "--json", "print one JSON object")
    parser.add_argument("--time-unit", choices=TIME_UNITS, help="unit of the sequence's own times, as the run had it")


def _add_compare(commands: Commands) -> None:
    parser, _ = _command(commands, "compare", "Put runs side by side: a table here, and a page with their pictures.")
    _value(parser, "runs", "RUN", "run folders", _path, nargs="+")
    page = Path("compare.html")
    _value(parser, "--out", "FILE", f"page to write (default: {page})", _path, default=page)
    _flag(parser, "--overwrite", "replace the page that is there")


def _add_explain(commands: Commands) -> None:
    parser, _ = _command(commands, "explain", "Print the decisions about a frame, with their numbers and thresholds.")
    _add_run_folder(parser, "a run folder; all decisions: of run --decisions")
    _value(parser, "--frame", "N", "index of the frame in the source", _count, required=True)


def _add_view(commands: Commands) -> None:
    parser, _ = _command(commands, "view", "Play a run in the Rerun viewer: camera, map, statuses, numbers, events.")
    _add_run_folder(parser)
    _value(parser, "--save", "FILE", "write the recording (.rrd) instead of opening it", _path)
    _flag(parser, "--overwrite", "replace the recording that is there")


def _add_export(commands: Commands) -> None:
    parser, _ = _command(commands, "export", "Write the map of a run in the format of another program.")
    _add_run_folder(parser)
    formats = "colmap and nerfstudio are folders, the others a file"
    parser.add_argument("--to", choices=EXPORTS, required=True, help=formats)
    _add_output(parser, "PATH", "folder or file to write")
    _add_distance(parser, "true distance between two frames: the export is in metres")
    images = parser.add_argument_group("images")
    _value(images, "--images", "SOURCE", "what the run was made of, if it has moved since")
    _value(images, "--every", "N", "besides keyframes, every N-th frame that has a pose", _positive)


def _add_scale(commands: Commands) -> None:
    parser, _ = _command(commands, "scale", "Tell a map how long its unit is: its exports are in metres from then on.")
    _add_run_folder(parser)
    known = parser.add_mutually_exclusive_group(required=True)
    _add_distance(known, "true distance between two frames")
    _value(known, "--height", "METRES", "of a level camera over the ground that it sees", _length)
    _value(known, "--marker", "METRES", "side of the black square of a marker", _length)
    _value(parser, "--images", "SOURCE", "what the run was made of, to look for markers")
    usual = DICTIONARIES[0]
    parser.add_argument("--dictionary", choices=DICTIONARIES, default=usual, help=f"of markers (default: {usual})")


def _add_measure(commands: Commands) -> None:
    parser, _ = _command(commands, "measure", "Put the map of a run into the frame of measurements, in metres.")
    _add_run_folder(parser)
    _add_measurements(parser, required=True)


def _add_merge(commands: Commands) -> None:
    parser, _ = _command(commands, "merge", "Join the maps of two runs that saw the same places.")
    _value(parser, "run_a", "RUN_A", "a run folder", _path)
    _value(parser, "run_b", "RUN_B", "a run folder; it may be of another camera", _path)
    _add_output(parser)
    _add_measurements(parser)
    of_b = "as --measurements, on the clock of RUN_B; repeatable"
    _value(parser, "--measurements-b", "FILE", of_b, _path, action="append", default=[])


def _add_render(commands: Commands) -> None:
    parser, _ = _command(commands, "render", "Render a synthetic world as a sequence folder with ground truth.")
    parser.add_argument("world", metavar="WORLD", choices=WORLDS, help=", ".join(WORLDS))
    _add_output(parser)
    _value(parser, "--frames", "N", "how many (default: 300)", _positive, default=300)
    _value(parser, "--seed", "N", "which world and path (default: 0)", _count, default=0)
    _value(parser, "--events", "FILE", "YAML list of blur, black-out, ... to inject", _path)


def _add_config(commands: Commands) -> None:
    parser, _ = _command(commands, "config", "Print the resolved configuration with the meaning of every field.")
    _add_configuration(parser)


def _add_demo(commands: Commands) -> None:
    parser, talk = _command(commands, "demo", "Lose track in a synthetic street: recovery off against on.")
    _value(parser, "--out", "DIR", "default: runs/demo", _path, default=Path("runs/demo"))
    _flag(parser, "--overwrite", "replace the runs that are there")
    _value(parser, "--frames", "N", "how long a drive (default: 170)", _positive, default=170)
    _flag(talk, "--profile", "print where the time went, stage by stage")
    _add_fields(parser)


def _add_bench(commands: Commands) -> None:
    parser, _ = _command(commands, "bench", "Run trials of sequences, variants and corruptions, and write the tables.")
    _value(parser, "spec", "SPEC", "YAML file, such as benchmarks/kitti.yaml", _path)
    _value(parser, "--out", "DIR", "folder; a bench goes on there (default: runs/NAME)", _path)
    _value(parser, "--data", "DIR", "folder in which the sequences of the bench are", _path)
    _value(parser, "--only", "SEQUENCE", "this sequence; repeatable", action="append", default=[])
    _value(parser, "--part", "PART", "this part; repeatable", action="append", default=[])
    _value(parser, "--trials", "N", "of each sequence and condition, over the spec's", _positive)
    _value(parser, "--limit", "N", "run N trials at most (0: only write the tables)", _count)
    half = "trials to choose settings on, or trials to publish; they share no seed (default: the spec's, reporting)"
    parser.add_argument("--half", choices=("development", "reporting"), help=half)
    where = parser.add_mutually_exclusive_group()
    _value(where, "--jobs", "N", "trials at the same time (default: one a CPU)", _positive)
    _value(where, "--scheduler", "ADDRESS", "run the trials on the workers of this Dask scheduler")


# --- what several commands have


def _add_run_folder(parser: argparse.ArgumentParser, help_text: str = "a run folder") -> None:
    _value(parser, "run", "RUN", help_text, _path)


def _add_output(parser: argparse.ArgumentParser, metavar: str = "DIR", help_text: str = "folder to write") -> None:
    _value(parser, "--out", metavar, help_text, _path, required=True)
    _flag(parser, "--overwrite", "replace what is there")


def _add_distance(group: argparse._ActionsContainer, help_text: str) -> None:
    names = ("FRAME", "FRAME", "METRES")
    group.add_argument("--distance", metavar=names, nargs=3, action=_Distance, help=help_text)


class _Distance(argparse.Action):
    """Two frames and a length."""

    def __call__(self, parser, namespace, values, option_string=None) -> None:  # type: ignore[no-untyped-def]
        try:
            setattr(namespace, self.dest, (int(values[0]), int(values[1]), _length(values[2])))
        except (ValueError, argparse.ArgumentTypeError):
            parser.error(f"argument {option_string}: give two frames and a distance in metres, as 10 250 3.2")


def _add_measurements(parser: argparse.ArgumentParser, required: bool = False) -> None:
    group = parser.add_argument_group("measurements")
    files = "GPS, odometry, gyroscope, ...: CSV, GPX, SRT, bag, folder of images with EXIF, oxts or imu0; repeatable"
    _value(group, "--measurements", "FILE", files, _path, action="append", default=[], required=required)
    _value(group, "--sigma", "X", "of files without sigmas: metres, or rad of an IMU", _length)
    _value(group, "--clock-offset", "SECONDS", "added to the measurements' times", float, default=0.0)


def _add_configuration(parser: argparse.ArgumentParser) -> None:
    _flag(_add_fields(parser), "--no-recovery", "do not link the maps before and after a failure")


def _add_fields(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    group = parser.add_argument_group("configuration")
    _value(group, "--config", "FILE", "YAML file; what it does not name keeps its default", _path)
    set_help = "set one field, over the file; repeatable"
    _value(group, "--set", "KEY.PATH=VALUE", set_help, action="append", default=[])
    _value(group, "--frontend", "NAME", "which front end (frontend.name)")
    _value(group, "--seed", "N", "seed of every random choice (seed)", _count)
    return group


def _add_selection(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("which frames")
    _value(group, "--start", "N", "first frame, counted from 0", _count, default=0)
    _value(group, "--stride", "N", "take every N-th frame", _positive, default=1)
    _value(group, "--max-frames", "N", "at most so many", _positive)
    _flag(group, "--reverse", "read the same frames last to first")


# --- values


def _path(text: str) -> Path:
    return Path(_named(text, "a file or a folder"))


def _source(text: str) -> str:
    return _named(text, "a folder, a video file or another source")


def _named(text: str, what: str) -> str:
    if not text:
        raise argparse.ArgumentTypeError(f"is empty; name {what}")
    return text


def _count(text: str, at_least: int = 0) -> int:
    try:
        value = int(text)
    except ValueError:
        value = at_least - 1
    if value < at_least:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least {at_least}, not {text!r}")
    return value


def _positive(text: str) -> int:
    return _count(text, 1)


def _port(text: str) -> int:
    port = _count(text)
    if port > MAX_PORT:
        raise argparse.ArgumentTypeError(f"{text!r} is no port: they end at {MAX_PORT}")
    return port


def _number(text: str, low: float, high: float, kind: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = low - 1.0
    if not low <= value <= high:
        raise argparse.ArgumentTypeError(f"must be {kind}, not {text!r}")
    return value


def _length(text: str) -> float:
    return _number(text, SHORTEST_M, LONGEST_M, f"a length in metres above 0, {SHORTEST_M:g} to {LONGEST_M:g}")


def _rate(text: str) -> float:
    return _number(text, 0.1, 1e4, "a rate between 0.1 and 10000 Hz")


def _angle(text: str) -> float:
    return _number(text, 1.0, math.nextafter(180.0, 0.0), "an angle between 1 and 180 degrees")
