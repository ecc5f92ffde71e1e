"""The command line (`dualslam run`, `eval`, `bench`, `render`, ...): it only words what the Python interface does."""

from __future__ import annotations

import argparse
import sys
import tempfile
import traceback
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

from dualslam.cli import logs
from dualslam.cli.parser import parse
from dualslam.cli.streams import lenient, without_libraries
from dualslam.core import exit_status
from dualslam.core.errors import ConfigError, DualSlamError, FrontendError, InputError, OutputError
from dualslam.core.resources import keep_freed_memory, limit_threads


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status. Never raises."""
    limit_threads()
    keep_freed_memory()
    arguments = list(sys.argv[1:] if argv is None else argv)
    with lenient() as out:
        status = _run(arguments)
        out.flush()
        if out.problem is None or isinstance(out.problem, BrokenPipeError):  # `dualslam config | head` has enough
            return status
        return _say(f"standard output cannot be written: {out.problem.strerror}", status or exit_status.FAILED)


def _run(arguments: list[str]) -> int:
    try:
        args = parse(arguments)
    except SystemExit as end:  # argparse has said what was wrong, or shown the help that was asked for
        return end.code if isinstance(end.code, int) else exit_status.BAD_INPUT
    with nullcontext() if args.verbose else without_libraries():
        return _execute(args, arguments)


def _execute(args: argparse.Namespace, arguments: list[str]) -> int:
    logs.set_up(args.verbose, args.quiet)
    try:
        status = int(args.execute(args))
        logs.release()
        return status
    except (ConfigError, InputError, OutputError, FrontendError) as error:
        logs.discard()
        return _say(error, exit_status.BAD_INPUT)
    except DualSlamError as error:
        return _say(error, exit_status.FAILED)
    except KeyboardInterrupt as stop:
        return _say(". ".join(["interrupted", *getattr(stop, "__notes__", ())]), exit_status.INTERRUPTED)
    except Exception as error:  # the last resort: a bug must not reach the user as a stack trace
        return _say(_report_bug(error, arguments, getattr(args, "out", None)), exit_status.FAILED)


def _say(sentence: object, status: int) -> int:
    words = " ".join([str(sentence), *getattr(sentence, "__notes__", ())]).split()
    print(f"dualslam: {' '.join(words)}", file=sys.stderr)
    return status


def _report_bug(error: Exception, arguments: list[str], out: Path | None) -> str:
    """Write the traceback to a file and return the sentence that says where it is."""
    text = f"dualslam {' '.join(arguments)}\n\n" + "".join(traceback.format_exception(error))
    folder = out if out is not None and out.is_dir() else Path(tempfile.gettempdir())
    try:
        with tempfile.NamedTemporaryFile(
            "w",
            prefix="dualslam-bug-",
            suffix=".log",
            dir=folder,
            delete=False,
            encoding="utf-8",
            errors="backslashreplace",
        ) as file:
            file.write(text)
        where = f"the traceback is in {file.name}"
    except OSError:
        where = "the traceback could not be written"
    detail = " ".join(str(error).split())
    notes = "".join(f". {note}" for note in getattr(error, "__notes__", ()))
    return f"this is a bug, please report it: {type(error).__name__}{': ' if detail else ''}{detail} ({where}){notes}"
