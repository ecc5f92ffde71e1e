"""Where the CPU time of the algorithm goes, by stage."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass
class StageTime:
    """CPU seconds and calls of one stage."""

    seconds: float = 0.0
    calls: int = 0


class StageTimer:
    """Adds up CPU seconds of the calling thread by stage name: what other threads decode meanwhile is not in."""

    def __init__(self) -> None:
        self.stages: dict[str, StageTime] = {}

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Count what runs inside to a stage."""
        start = time.thread_time()
        try:
            yield
        finally:
            self.add(stage, time.thread_time() - start)

    def add(self, stage: str, seconds: float) -> None:
        """Count seconds that were measured elsewhere."""
        total = self.stages.setdefault(stage, StageTime())
        total.seconds += seconds
        total.calls += 1
