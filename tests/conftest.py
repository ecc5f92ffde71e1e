"""Tests compute as the command line does: with one thread for each numerical library, or sums round otherwise."""

import logging
import signal

import pytest
from hypothesis import HealthCheck, settings

from dualslam.core.resources import limit_threads

limit_threads()

# The same examples each time, however busy the machine is.
settings.register_profile(
    "dualslam",
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
settings.load_profile("dualslam")

# A shell hands Ctrl-C to what it starts in the background (`&`, nohup) as ignored; tests that interrupt a run need it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run files with slow tests first: short tests are left for the end, so that no worker waits long for another."""
    slow = {item.path for item in items if "slow" in item.keywords or item.path.suffix == ".ipynb"}
    items.sort(key=lambda item: item.path not in slow)


@pytest.fixture(autouse=True)
def _log_level() -> None:
    """A command with `--quiet` logs errors alone from then on; the tests after it begin as if there had been none."""
    logging.getLogger().setLevel(logging.WARNING)
