"""Where the time of the algorithm goes, by stage: CPU and wall."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass
class StageTime:
    """CPU seconds, calls and wall seconds of one stage; `longest_s`: wall time of its longest call."""

    seconds: float = 0.0
    calls: int = 0
    wall_s: float = 0.0
    longest_s: float = 0.0


class StageTimer:
    """Adds up CPU seconds of the calling thread by stage name: what other threads decode meanwhile is not in."""

    def __init__(self) -> None:
        self.stages: dict[str, StageTime] = {}

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Count what runs inside to a stage."""
        start, wall_start = time.thread_time(), time.perf_counter()
        try:
            yield
        finally:
            self.add(stage, time.thread_time() - start, time.perf_counter() - wall_start)

    def add(self, stage: str, seconds: float, wall_s: float = 0.0) -> None:
        """Count CPU seconds that were measured elsewhere, and the wall time, where that is known."""
        total = self.stages.setdefault(stage, StageTime())
        total.seconds += seconds
        total.calls += 1
        total.wall_s += wall_s
        total.longest_s = max(total.longest_s, wall_s)
