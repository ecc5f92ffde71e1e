"""Runs as the report's tests have them, and a rendered folder as the command's have it."""

from tests.cli.conftest import _own_environment, folder
from tests.report.conftest import broken_run, make_run, world

__all__ = ["_own_environment", "broken_run", "folder", "make_run", "world"]
