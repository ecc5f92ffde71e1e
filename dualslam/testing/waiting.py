"""How tests wait for what another thread or process does."""

from __future__ import annotations

import time
from collections.abc import Callable


def wait_until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    """Return as soon as the condition holds; fail where it does not within so long."""
    end_s = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end_s, f"still not so after {seconds:g} s"
        time.sleep(0.001)
