"""The one tree of exceptions: bad input and bugs. An estimate that fails is a `Failure` value, not an exception."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[2]


class DualSlamError(Exception):
    """Base of every error that dualslam raises on purpose. Its message says what was wrong, where, and what to do."""


class ConfigError(DualSlamError):
    """A configuration file, `--set` override or config object is not valid. Names the field.

    Attributes
    ----------
    problem : str
        What is wrong.
    field : tuple of str or int
        Path to the field, with which the message then begins. Empty if it concerns several, or if `problem` names it.
    """

    def __init__(self, problem: str, field: tuple[str | int, ...] = ()) -> None:
        super().__init__(problem, field)
        self.problem = problem
        self.field = field

    def __str__(self) -> str:
        return f"{written(self.field)}: {self.problem}" if self.field else self.problem


class InputError(DualSlamError):
    """A sequence, image, calibration or trajectory cannot be read or makes no sense. Names the file."""


class NoCalibrationError(InputError):
    """Images that can be read, of a camera of which nothing is known."""


class OutputError(DualSlamError):
    """A result cannot be written where it was asked for. Names the path."""


class FrontendError(DualSlamError):
    """A front end of another package raises, or returns what is none of features. Names it, and where."""


class SolverError(DualSlamError):
    """The factor graph cannot be solved, and could not be rebuilt either. Names the graph and the variable."""


def written(path: Iterable[str | int]) -> str:
    """Return the path to a field of the configuration as messages write it: ``recovery.attempts[1].frontend``."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path).removeprefix(".")


def check_exists(source: Path) -> None:
    """Refuse a path at which there is nothing.

    Raises `InputError`.
    """
    if not source.exists():
        raise InputError(
            f"{source} does not exist; give a sequence folder, a video file, the number of a webcam or the "
            "address of a stream."
        )


def how_to_install(extra: str) -> str:
    """Return the command that installs an extra: of this checkout, or of the installed wheel."""
    if (_ROOT / "pyproject.toml").is_file():
        return f'pip install -e "{_ROOT}[{extra}]"'
    return f'pip install "dualslam[{extra}]"'
