"""Reading in a thread of its own, a bounded number of items ahead of the consumer."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterator
from threading import Condition, Thread
from typing import Generic, TypeVar

T = TypeVar("T")


def read_ahead(items: Iterator[T], depth: int = 8, *, drop_oldest: bool = False) -> Generator[T, None, None]:
    """Yield `items`, produced on another thread.

    The thread starts with the first item asked for. It ends when the items do, or when this generator is closed, as by
    a ``break`` in the consumer's loop. If the items raise, the exception comes out here, after the items before it.

    - `items`: closed on its own thread if it is a generator.
    - `depth`: how many items may wait: the next one is produced once one of so many has been consumed.
    - `drop_oldest`: for live sources: a full queue drops its oldest item instead of making the producer wait.
    """
    channel: _Channel[T] = _Channel(depth, drop_oldest)
    thread = Thread(target=channel.produce, args=(items,), name="dualslam-read-ahead", daemon=True)
    thread.start()
    try:
        yield from channel.consume()
    finally:
        channel.stop()
        thread.join()


class _Channel(Generic[T]):
    """The queue between the two threads, with an end and a stop that neither side can miss."""

    def __init__(self, depth: int, drop_oldest: bool) -> None:
        self._changed = Condition()
        self._waiting: deque[T] = deque()
        self._depth = depth
        self._drop_oldest = drop_oldest
        self._stopped = False
        self._ended = False
        self._error: BaseException | None = None

    def produce(self, items: Iterator[T]) -> None:
        try:
            for item in items:
                self._put(item)
                if not self._wait_for_room():
                    break
        except BaseException as e:  # handed to the consumer, which raises it
            self._error = e
        finally:
            try:
                if isinstance(items, Generator):
                    items.close()
            finally:
                with self._changed:
                    self._ended = True
                    self._changed.notify_all()

    def _wait_for_room(self) -> bool:
        """Wait until there is room for an item, before it is produced; return False once nobody wants one any more."""
        with self._changed:
            while len(self._waiting) >= self._depth and not self._drop_oldest and not self._stopped:
                self._changed.wait()
            return not self._stopped

    def _put(self, item: T) -> None:
        with self._changed:
            if len(self._waiting) >= self._depth:
                self._waiting.popleft()
            self._waiting.append(item)
            self._changed.notify_all()

    def consume(self) -> Iterator[T]:
        while True:
            with self._changed:
                while not self._waiting and not self._ended:
                    self._changed.wait()
                if not self._waiting:
                    if self._error is not None:
                        raise self._error
                    return
                item = self._waiting.popleft()
                self._changed.notify_all()
            yield item

    def stop(self) -> None:
        with self._changed:
            self._stopped = True
            self._waiting.clear()
            self._changed.notify_all()
