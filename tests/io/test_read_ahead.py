"""The reading thread: order, bound, errors, and that it is gone when nobody reads any more."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from dualslam.io import open_sequence
from dualslam.io.read_ahead import read_ahead
from dualslam.testing.waiting import wait_until


def reading_threads() -> list[threading.Thread]:
    return [t for t in threading.enumerate() if t.name == "dualslam-read-ahead"]


class Counting:
    """Counts how far it was read, and whether it was closed."""

    def __init__(self) -> None:
        self.made = 0
        self.closed_on: str | None = None

    def items(self, n: int) -> Iterator[int]:
        try:
            for i in range(n):
                self.made = i + 1
                yield i
        finally:
            self.closed_on = threading.current_thread().name


def test_gives_everything_in_order_and_ends_its_thread() -> None:
    source = Counting()
    assert list(read_ahead(source.items(100), depth=3)) == list(range(100))
    assert source.closed_on == "dualslam-read-ahead"
    assert not reading_threads()


def test_runs_ahead_by_its_depth_and_no_more() -> None:
    source = Counting()
    stream = read_ahead(source.items(100), depth=3)
    assert source.made == 0, "nothing happens before the first item is asked for"
    assert next(stream) == 0
    # One was taken, and three wait.
    wait_until(lambda: source.made == 4, seconds=5)
    time.sleep(0.02)
    assert source.made == 4
    assert next(stream) == 1
    wait_until(lambda: source.made == 5, seconds=5)
    stream.close()


def test_stopping_early_ends_the_thread_and_closes_the_source() -> None:
    source = Counting()
    for item in read_ahead(source.items(1000), depth=2):
        if item == 3:
            break
    gc.collect()
    wait_until(lambda: not reading_threads(), seconds=5)
    assert source.closed_on == "dualslam-read-ahead"
    assert source.made < 10


def test_an_exception_comes_out_after_the_items_before_it() -> None:
    def failing() -> Iterator[int]:
        yield 1
        yield 2
        raise ValueError("broken source")

    stream = read_ahead(failing())
    assert [next(stream), next(stream)] == [1, 2]
    with pytest.raises(ValueError, match="broken source"):
        next(stream)
    assert not reading_threads()


def test_an_exception_in_the_consumer_ends_the_thread() -> None:
    def consume() -> None:
        for _ in read_ahead(iter(range(1000)), depth=2):
            raise RuntimeError("consumer")

    with pytest.raises(RuntimeError, match="consumer"):
        consume()
    gc.collect()
    wait_until(lambda: not reading_threads(), seconds=5)


def test_a_live_source_drops_its_oldest() -> None:
    produced = threading.Event()

    def live() -> Iterator[int]:
        yield from range(50)
        produced.set()

    stream = read_ahead(live(), depth=2, drop_oldest=True)
    first = next(stream)
    produced.wait(5)
    assert [first, *stream][-2:] == [48, 49]


def test_a_sequence_left_early_leaves_no_thread(dataset: Path) -> None:
    sequence = open_sequence(dataset)
    for _ in range(20):
        iterator = iter(sequence)
        next(iterator)
        del iterator
    for frame in sequence:
        if frame.index == 1:
            break
    gc.collect()
    wait_until(lambda: not reading_threads(), seconds=5)


def test_two_readings_at_once_do_not_disturb_each_other(dataset: Path) -> None:
    sequence = open_sequence(dataset)
    assert [(a.index, b.index) for a, b in zip(sequence, sequence, strict=True)] == [(i, i) for i in range(6)]
