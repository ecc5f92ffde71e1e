"""Tests compute as the command line does: with one thread for each numerical library, or sums round otherwise."""

import logging
import signal
from collections.abc import Iterator

import pytest

from dualslam.core.threads import limit_threads

limit_threads()

# A shell hands Ctrl-C to what it starts in the background (`&`, nohup) as ignored; tests that interrupt a run need it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def _log_level() -> Iterator[None]:
    """What a command with `--quiet` no longer logs, later tests may ask for."""
    root = logging.getLogger()
    before = root.level
    yield
    root.setLevel(before)
