"""Toy work for a desk: a module of its own, because workers are spawned and import what they do."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from dualslam.core.jobs import Handlers, JobKind
from dualslam.core.types import Features
from dualslam.workers.desk import Lane, WorkerDesk


@contextmanager
def working(*lanes: Lane, finish_wait_s: float = 30.0) -> Iterator[WorkerDesk]:
    """Open a desk, and close it."""
    desk = WorkerDesk(lanes, finish_wait_s)
    try:
        yield desk
    finally:
        desk.close()


def lane(*kinds: JobKind, time_limit_s: float = 60.0, **settings: Any) -> Lane:
    """Return a lane of one process that does toy work."""
    return Lane("toys", kinds, handlers, 1, time_limit_s, **settings)


def handlers() -> Handlers:
    """Graph jobs keep a sum, as a graph keeps a state; walks obey their job; calibrations double an array."""
    total = 0.0

    def add(number: float) -> float:
        nonlocal total
        total += number
        return total

    return {JobKind.GRAPH: add, JobKind.WALK: obey, JobKind.CALIBRATION: double, JobKind.FEATURES: look}


def obey(order: tuple[str, float]) -> Any:
    """`die` at once, `sleep` so many seconds, or say who is asked: its process id and its niceness."""
    what, seconds = order
    if what == "die":
        os._exit(3)
    time.sleep(seconds)
    return os.getpid(), os.nice(0)


def look(image: np.ndarray) -> Features:
    """Find one feature, as bright as the image's first pixel; a black one is death."""
    if not image[0, 0]:
        os._exit(3)
    one, uv = np.ones(1), np.zeros((1, 2))
    return Features(uv, uv, one, one, np.zeros(1, np.int64), one, image[:1, :1])


def double(array: np.ndarray) -> np.ndarray:
    """In place, to see that it may be written to, and is nobody else's."""
    array *= 2
    return array
