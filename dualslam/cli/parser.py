"""Commands, options and their help. Nothing heavy is imported until a command executes."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import NoReturn

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
        self.exit(2, f"{self.prog}: {message}{self._meant(message)}; see {self.prog} --help\n")

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


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse a command line; the result's `execute` is the function to call with it.

    Raises `SystemExit`: with status 2 and one sentence on stderr where the usage is wrong; with 0 after ``--help`` and
    ``--version``.
    """
    return _build_parser().parse_args(arguments)


def _build_parser() -> _Parser:
    parser = _Parser(
        prog="dualslam", description="Monocular SLAM that recovers from tracking failure.", epilog=EXIT_STATUSES
    )
    parser.add_argument("--version", action="version", version=f"dualslam {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True, parser_class=_Parser)
    _add_run(commands)
    _add_eval(commands)
    _add_compare(commands)
    _add_explain(commands)
    _add_view(commands)
    _add_export(commands)
    _add_scale(commands)
    _add_measure(commands)
    _add_merge(commands)
    _add_render(commands)
    _add_config(commands)
    _add_demo(commands)
    _add_bench(commands)
    return parser


def _command(
    commands: argparse._SubParsersAction[_Parser], name: str, help_text: str
) -> tuple[_Parser, argparse._ArgumentGroup]:
    parser = commands.add_parser(name, help=help_text, description=help_text, allow_abbrev=False)
    parser.set_defaults(execute=_late(name))
    talk = parser.add_argument_group("talk")
    talk.add_argument("-q", "--quiet", action="store_true", help="print nothing but errors")
    talk.add_argument("-v", "--verbose", action="count", default=0, help="log what happens; twice: every detail")
    return parser, talk


def _late(name: str) -> Callable[[argparse.Namespace], int]:
    """Return a function that imports a command's module when it is called."""

    def execute(args: argparse.Namespace) -> int:
        with held_back():
            early = import_module("dualslam.cli.early")
        early.check(args)
        with held_back():
            command = import_module(f"dualslam.cli.{name}_command")
        status: int = command.execute(args)
        return status

    return execute


def _add_run(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser, talk = _command(commands, "run", "Run on a source of frames and write a run folder.")
    parser.add_argument("source", metavar="SOURCE", type=_source, help=SOURCE_HELP)
    parser.add_argument("--topic", metavar="NAME", help="topic of the images, where SOURCE is a bag of several")
    _add_output(parser)
    parser.add_argument("--decisions", action="store_true", help="write decisions.jsonl, which dualslam explain prints")
    talk.add_argument("--profile", action="store_true", help="print where the time went, stage by stage")
    _add_configuration(parser)
    _add_selection(parser)
    parser.add_argument_group("failure lab").add_argument(
        "--corrupt",
        metavar="FILE",
        type=_path,
        help="YAML list of corruptions and faults for this run (corruptions), as - {kind: blur, start: 50, length: 9}",
    )
    images = parser.add_argument_group("camera")
    camera = images.add_mutually_exclusive_group()
    camera.add_argument("--camera", metavar="FILE", type=_path, help="calibration, instead of the source's own")
    camera.add_argument(
        "--fov",
        metavar="DEGREES",
        type=_angle,
        help="field of view along the longer side of the images, without a calibration",
    )
    images.add_argument(
        "--mask",
        metavar="FILE",
        type=_path,
        help="image whose black pixels show no scene; or a folder with one for each frame (camera.mask)",
    )
    images.add_argument("--full-size", action="store_true", help="read images of more than 2048 pixels as they are")
    clock = parser.add_argument_group("clock").add_mutually_exclusive_group()
    clock.add_argument("--rate", metavar="HZ", type=_rate, help="frames a second, instead of the source's own times")
    clock.add_argument("--time-unit", choices=TIME_UNITS, help="unit of the source's own times; by default seconds")
    _add_measurements(parser)
    saved = parser.add_argument_group("saved map")
    saved.add_argument(
        "--map", metavar="DIR", type=_path, help="run folder whose map this run finds its frames in, and extends"
    )
    saved.add_argument("--localise", action="store_true", help="find poses in the map of --map, and add nothing to it")
    mode = parser.add_argument_group("mode")
    mode.add_argument(
        "--realtime",
        action="store_true",
        help="frames come at the source's rate and are dropped when late; otherwise every frame, as fast as it goes",
    )
    mode.add_argument(
        "--replay",
        metavar="RUN",
        type=_path,
        help="repeat a run in one process, to the bit, by the schedule in its folder; SOURCE and --map as it had them",
    )
    mode.add_argument(
        "--live",
        metavar="PORT",
        type=_port,
        nargs="?",
        const=0,
        help="watch the run in a browser, on a port of this machine (a free one without a number)",
    )
    processes = mode.add_mutually_exclusive_group()
    processes.add_argument("--inline", action="store_true", help="one process, deterministic: --workers 0, the default")
    processes.add_argument(
        "--workers",
        metavar="N",
        type=_count,
        help="processes for long background work, and one for its graph; --realtime: 1, and one for features",
    )


def _add_eval(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser, _ = _command(commands, "eval", "Score a run against ground truth: coverage first, then ATE and RPE.")
    parser.add_argument("run", metavar="RUN", type=_path, help="a run folder, or a trajectory in TUM format")
    parser.add_argument("sequence", metavar="SEQUENCE", type=_source, help="the sequence with its ground truth")
    parser.add_argument("--keyframes-only", action="store_true", help="the error of keyframes, besides all frames'")
    parser.add_argument(
        "--returns", action="store_true", help="the sequence ends where it began: an error that needs no ground truth"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--time-unit", choices=TIME_UNITS, help="unit of the sequence's own times, as the run had it")


def _add_compare(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser, _ = _command(commands, "compare", "Put runs side by side: a table here, and a page with their pictures.")
    parser.add_argument("runs", metavar="RUN", type=_path, nargs="+", help="run folders")
    parser.add_argument(
        "--out", metavar="FILE", type=_path, default=Path("compare.html"), help="page to write (default: compare.html)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace the page that is there")


def _add_explain(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser, _ = _command(commands, "explain", "Print the decisions about a frame, with their numbers and thresholds.")
    parser.add_argument("run", metavar="RUN", type=_path, help="a run folder; all decisions: of run --decisions")
    parser.add_argument("--frame", metavar="N", type=_count, required=True, help="index of the frame in the source")


def _add_view(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser, _ = _command(commands, "view", "Play a run in the Rerun viewer: camera, map, statuses, numbers, events.")
    parser.add_argument("run", metavar="RUN", type=_path, help="a run folder")
    parser.add_argument("--save", metavar="FILE", type=_path, help="write the recording (.rrd) instead of opening it")
    parser.add_argument("--overwrite", action="store_true", help="replace the recording that is there")


def _add_export(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser, _ = _command(commands, "export", "Write the map of a run in the format of another program.")
    parser.add_argument("run", metavar="RUN", type=_path, help="a run folder")
    parser.add_argument(
        "--to", choices=EXPORTS, required=True, help="colmap and nerfstudio are folders, the others a file"
    )
    parser.add_argument("--out", metavar="PATH", type=_path, required=True, help="folder or file to write")
    parser.add_argument("--overwrite", action="store_true", help="replace what is there")
    parser.add_argument(
        "--distance",
        metavar=("FRAME", "FRAME", "METRES"),
        nargs=3,
        action=_Distance,
        help="true distance between two frames: the export is in metres",
    )
    images = parser.add_argument_group("images")
    images.add_argument("--images", metavar="SOURCE", help="what the run was made of, if it has moved since")
    images.add_argument(
        "--every", metavar="N", type=_positive, help="besides keyframes, every N-th frame that has a pose"
    )


def _add_scale(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser, _ = _command(commands, "scale", "Tell a map how long its unit is: its exports are in metres from then on.")
    parser.add_argument("run", metavar="RUN", type=_path, help="a run folder")
    known = parser.add_mutually_exclusive_group(required=True)
    known.add_argument(
        "--distance",
        metavar=("FRAME", "FRAME", "METRES"),
        nargs=3,
        action=_Distance,
        help="true distance between two frames",
    )
    known.add_argument(
        "--height", metavar="METRES", type=_length, help="of a level camera over the ground that it sees"
    )
    known.add_argument("--marker", metavar="METRES", type=_length, help="side of the black square of a marker")
    parser.add_argument("--images", metavar="SOURCE", help="what the run was made of, to look for markers")
    parser.add_argument(
        "--dictionary", choices=DICTIONARIES, default=DICTIONARIES[0], help=f"of markers (default: {DICTIONARIES[0]})"
    )


def _add_measurements(parser: argparse.ArgumentParser, required: bool = False) -> None:
    group = parser.add_argument_group("measurements")
    group.add_argument(
        "--measurements",
        metavar="FILE",
        type=_path,
        action="append",
        default=[],
        required=required,
        help="GPS, odometry, gyroscope, ...: CSV, GPX, SRT, bag, folder of images with EXIF, oxts or imu0; repeatable",
    )
    group.add_argument("--sigma", metavar="X", type=_length, help="of files without sigmas: metres, or rad of an IMU")
    group.add_argument(
        "--clock-offset", metavar="SECONDS", type=float, default=0.0, help="added to the measurements' times"
    )


def _add_measure(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser, _ = _command(commands, "measure", "Put the map of a run into the frame of measurements, in metres.")
    parser.add_argument("run", metavar="RUN", type=_path, help="a run folder")
    _add_measurements(parser, required=True)


def _add_merge(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser, _ = _command(commands, "merge", "Join the maps of two runs that saw the same places.")
    parser.add_argument("run_a", metavar="RUN_A", type=_path, help="a run folder")
    parser.add_argument("run_b", metavar="RUN_B", type=_path, help="a run folder; it may be of another camera")
    _add_output(parser)
    _add_measurements(parser)
    parser.add_argument(
        "--measurements-b",
        metavar="FILE",
        type=_path,
        action="append",
        default=[],
        help="as --measurements, on the clock of RUN_B; repeatable",
    )


class _Distance(argparse.Action):
    """Two frames and a length."""

    def __call__(self, parser, namespace, values, option_string=None) -> None:  # type: ignore[no-untyped-def]
        try:
            setattr(namespace, self.dest, (int(values[0]), int(values[1]), _length(values[2])))
        except (ValueError, argparse.ArgumentTypeError):
            parser.error(f"argument {option_string}: give two frames and a distance in metres, as 10 250 3.2")


def _add_render(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser, _ = _command(commands, "render", "Render a synthetic world as a sequence folder with ground truth.")
    parser.add_argument("world", metavar="WORLD", choices=WORLDS, help=", ".join(WORLDS))
    _add_output(parser)
    parser.add_argument("--frames", metavar="N", type=_positive, default=300, help="how many (default: 300)")
    parser.add_argument("--seed", metavar="N", type=_count, default=0, help="which world and path (default: 0)")
    parser.add_argument("--events", metavar="FILE", type=_path, help="YAML list of blur, black-out, ... to inject")


def _add_config(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser, _ = _command(commands, "config", "Print the resolved configuration with the meaning of every field.")
    _add_configuration(parser)


def _add_demo(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser, talk = _command(commands, "demo", "Lose track in a synthetic street: recovery off against on.")
    parser.add_argument("--out", metavar="DIR", type=_path, default=Path("runs/demo"), help="default: runs/demo")
    parser.add_argument("--overwrite", action="store_true", help="replace the runs that are there")
    parser.add_argument("--frames", metavar="N", type=_positive, default=170, help="how long a drive (default: 170)")
    talk.add_argument("--profile", action="store_true", help="print where the time went, stage by stage")
    _add_fields(parser)


def _add_bench(commands: argparse._SubParsersAction[_Parser]) -> None:
    parser, _ = _command(commands, "bench", "Run trials of sequences, variants and corruptions, and write the tables.")
    parser.add_argument("spec", metavar="SPEC", type=_path, help="YAML file, such as benchmarks/kitti.yaml")
    parser.add_argument("--out", metavar="DIR", type=_path, help="folder; a bench goes on there (default: runs/NAME)")
    parser.add_argument("--data", metavar="DIR", type=_path, help="folder in which the sequences of the bench are")
    parser.add_argument("--only", metavar="SEQUENCE", action="append", default=[], help="this sequence; repeatable")
    parser.add_argument("--part", metavar="PART", action="append", default=[], help="this part; repeatable")
    parser.add_argument("--trials", metavar="N", type=_positive, help="of each sequence and condition, over the spec's")
    parser.add_argument("--limit", metavar="N", type=_count, help="run N trials at most (0: only write the tables)")
    parser.add_argument(
        "--half",
        choices=("development", "reporting"),
        help="trials to choose settings on, or trials to publish; they share no seed (default: the spec's, reporting)",
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--jobs", metavar="N", type=_positive, help="trials at the same time (default: one a CPU)")
    where.add_argument("--scheduler", metavar="ADDRESS", help="run the trials on the workers of this Dask scheduler")


def _add_output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", metavar="DIR", type=_path, required=True, help="folder to write")
    parser.add_argument("--overwrite", action="store_true", help="replace what is there")


def _add_configuration(parser: argparse.ArgumentParser) -> None:
    group = _add_fields(parser)
    group.add_argument("--no-recovery", action="store_true", help="do not link the maps before and after a failure")


def _add_fields(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    group = parser.add_argument_group("configuration")
    group.add_argument(
        "--config", metavar="FILE", type=_path, help="YAML file; what it does not name keeps its default"
    )
    group.add_argument(
        "--set", metavar="KEY.PATH=VALUE", action="append", default=[], help="set one field, over the file; repeatable"
    )
    group.add_argument("--frontend", metavar="NAME", help="which front end (frontend.name)")
    group.add_argument("--seed", metavar="N", type=_count, help="seed of every random choice (seed)")
    return group


def _add_selection(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("which frames")
    group.add_argument("--start", metavar="N", type=_count, default=0, help="first frame, counted from 0")
    group.add_argument("--stride", metavar="N", type=_positive, default=1, help="take every N-th frame")
    group.add_argument("--max-frames", metavar="N", type=_positive, help="at most so many")
    group.add_argument("--reverse", action="store_true", help="read the same frames last to first")


def _path(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError("is empty; name a file or a folder")
    return Path(text)


def _source(text: str) -> str:
    if not text:
        raise argparse.ArgumentTypeError("is empty; name a folder, a video file or another source")
    return text


def _integer(text: str, at_least: int) -> int:
    try:
        value = int(text)
    except ValueError:
        value = at_least - 1
    if value < at_least:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least {at_least}, not {text!r}")
    return value


def _count(text: str) -> int:
    return _integer(text, 0)


def _port(text: str) -> int:
    port = _integer(text, 0)
    if port > MAX_PORT:
        raise argparse.ArgumentTypeError(f"{text!r} is no port: they end at {MAX_PORT}")
    return port


def _positive(text: str) -> int:
    return _integer(text, 1)


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
