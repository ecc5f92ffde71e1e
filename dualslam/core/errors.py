"""The one tree of exceptions: bad input and bugs. An estimate that fails is a `Failure` value, not an exception."""

from __future__ import annotations


class DualSlamError(Exception):
    """Base of every error that dualslam raises on purpose. Its message says what was wrong, where, and what to do."""


class ConfigError(DualSlamError):
    """A configuration file, `--set` override or config object is not valid. Names the field."""


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
