"""Objects of numpy arrays through a pipe: large arrays go past the pickle, and what was sent before is not sent again.

Pickling holds the interpreter's lock, and so does each turn at a pipe. So only the structure is pickled. The memory of
large arrays is written from its place, many pieces with one system call, which holds no lock.

Features and images never change, and most of a job is made of those that the one before held already. Each goes through
a `Channel` once, and the worker keeps it as long as the tracking process does. An object stays the same object in the
worker, job after job. The other way nothing is kept: what a worker has made is whole in its result.
"""

from __future__ import annotations

import io
import os
import pickle
import select
import struct
import weakref
from collections.abc import Callable, Sequence
from itertools import count
from multiprocessing.connection import Connection
from typing import Any

from dualslam.core.grey_image import GreyImage
from dualslam.core.types import Features

LARGE_BYTES = 2**14
"""Arrays from here on go beside the pickle; a smaller one is copied faster than it is handled apart."""
MAX_PIECES = 512
"""In one call of the system; Linux and macOS take 1,024."""
ONCE = (Features, GreyImage)
"""Immutable, large, and held by job after job."""

_COUNT = struct.Struct("<Q")


class Channel:
    """One end of a pipe.

    `gives`: whether this end gives jobs, and says what is kept; the other one does them, and keeps.
    """

    def __init__(self, connection: Connection, gives: bool) -> None:
        self._connection = connection
        self._gives = gives
        self._numbers = count()
        self._number_of: weakref.WeakKeyDictionary[Any, int] = weakref.WeakKeyDictionary()
        self._given: weakref.WeakValueDictionary[int, Any] = weakref.WeakValueDictionary()
        self._kept: dict[int, Any] = {}
        self._gone: list[int] = []  # given, and held by nobody here any more

    def send(self, thing: Any) -> int:
        """Send what can be pickled; blocks until all of it is under way, and returns how many bytes it was.

        Raises `OSError`: nobody is at the other end any more.
        """
        large: list[memoryview] = []
        fresh: dict[int, Any] = {}
        gone = list(self._gone)
        del self._gone[: len(gone)]  # others may go meanwhile, whichever thread lets go of them
        stream = io.BytesIO()
        _Pickler(stream, self, fresh, large).dump(thing)
        n_before = len(large)
        head = pickle.dumps((fresh, gone), protocol=5, buffer_callback=_beside(large))
        pieces = [memoryview(head), stream.getbuffer(), *large[n_before:], *large[:n_before]]
        sizes = [piece.nbytes for piece in pieces]
        table = b"".join(_COUNT.pack(n) for n in (len(sizes), n_before, *sizes))
        _write(self._connection.fileno(), [memoryview(table), *pieces])
        return len(table) + sum(sizes)

    def send_in_passing(self, thing: Any) -> bool:
        """Send what is small, if the other end has kept up, and else let it be lost: this never waits.

        A pipe counts as free while most of its buffer is; that is some ten times the size of such a message.

        Raises `OSError`: nobody is at the other end any more.
        """
        free = select.poll()
        free.register(self._connection.fileno(), select.POLLOUT)
        if not free.poll(0):
            return False
        self.send(thing)
        return True

    def receive(self) -> Any:
        """Wait for what the other end sends, and return it; its arrays can be written to, each in memory of its own.

        Raises `EOFError`: the other end was closed.
        """
        fd = self._connection.fileno()
        n, n_own = (_COUNT.unpack(each)[0] for each in _read(fd, [_COUNT.size] * 2))
        sizes = [_COUNT.unpack(each)[0] for each in _read(fd, [_COUNT.size] * n)]
        head, body, *large = _read(fd, sizes)
        n_fresh = len(large) - n_own
        fresh, gone = pickle.loads(head, buffers=large[:n_fresh])
        for number, kept in fresh.items():
            self._kept[number] = kept
            self._number_of[kept] = number
        thing = _Unpickler(io.BytesIO(body), self, buffers=large[n_fresh:]).load()
        for number in gone:
            del self._kept[number]
        return thing

    def number(self, thing: Any, fresh: dict[int, Any]) -> int | None:
        """Return the number of what goes once, put among the fresh ones if it has never gone; None: it goes whole."""
        number = self._number_of.get(thing)
        if number is None and self._gives:
            number = self._number_of[thing] = next(self._numbers)
            self._given[number] = fresh[number] = thing
            weakref.finalize(thing, self._gone.append, number).atexit = False
        return number

    def named(self, number: int) -> Any:
        """Return what has this number."""
        return self._given[number] if self._gives else self._kept[number]


class _Pickler(pickle.Pickler):
    def __init__(self, stream: io.BytesIO, channel: Channel, fresh: dict[int, Any], large: list[memoryview]) -> None:
        super().__init__(stream, protocol=5, buffer_callback=_beside(large))
        self._channel, self._fresh = channel, fresh

    def persistent_id(self, obj: Any) -> int | None:
        return self._channel.number(obj, self._fresh) if isinstance(obj, ONCE) else None


class _Unpickler(pickle.Unpickler):
    def __init__(self, stream: io.BytesIO, channel: Channel, buffers: Sequence[bytearray]) -> None:
        super().__init__(stream, buffers=buffers)
        self._channel = channel

    def persistent_load(self, pid: Any) -> Any:
        return self._channel.named(pid)


def _beside(large: list[memoryview]) -> Callable[[pickle.PickleBuffer], bool]:
    """Return what keeps large buffers out of a pickle, and puts them at the end of a list."""

    def keep_out(buffer: pickle.PickleBuffer) -> bool:
        memory = buffer.raw()
        if memory.nbytes < LARGE_BYTES:
            return True  # into the pickle
        large.append(memory)
        return False

    return keep_out


def _write(fd: int, pieces: Sequence[memoryview]) -> None:
    waiting = [piece for piece in pieces if piece.nbytes]
    begin = 0
    while begin < len(waiting):
        written = os.writev(fd, waiting[begin : begin + MAX_PIECES])
        while begin < len(waiting) and written >= waiting[begin].nbytes:
            written -= waiting[begin].nbytes
            begin += 1
        if written:
            waiting[begin] = waiting[begin][written:]


def _read(fd: int, sizes: Sequence[int]) -> list[bytearray]:
    pieces = [bytearray(size) for size in sizes]
    waiting = [memoryview(piece) for piece in pieces if piece]
    begin = 0
    while begin < len(waiting):
        got = os.readv(fd, waiting[begin : begin + MAX_PIECES])
        if got == 0:
            raise EOFError
        while begin < len(waiting) and got >= waiting[begin].nbytes:
            got -= waiting[begin].nbytes
            begin += 1
        if got:
            waiting[begin] = waiting[begin][got:]
    return pieces
