"""Objects of numpy arrays through a pipe: what is small is pickled, large arrays go past the pickle as they are.

Pickling holds the interpreter's lock, and so does each turn at a pipe: a thread that carries a job of a thousand arrays
must come to its turn a thousand times beside the one that tracks. So the structure alone is pickled, the memory of
large arrays is written from where it lies, and many pieces go with one call of the system, which holds no lock.
"""

from __future__ import annotations

import os
import pickle
import struct
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any

LARGE_BYTES = 2**14
"""Arrays from here on go beside the pickle; a smaller one is copied faster than it is handled apart."""
MAX_PIECES = 512
"""In one call of the system; Linux and macOS take 1,024."""

_COUNT = struct.Struct("<Q")


def send(connection: Connection, thing: Any) -> int:
    """Send what can be pickled; blocks until all of it is under way, and returns how many bytes it was.

    Raises
    ------
    OSError
        Nobody is at the other end any more.
    """
    large: list[memoryview] = []

    def beside(buffer: pickle.PickleBuffer) -> bool:
        memory = buffer.raw()
        if memory.nbytes < LARGE_BYTES:
            return True  # into the pickle
        large.append(memory)
        return False

    structure = pickle.dumps(thing, protocol=5, buffer_callback=beside)
    sizes = [len(structure), *(memory.nbytes for memory in large)]
    head = b"".join(_COUNT.pack(n) for n in (len(sizes), *sizes))
    _write(connection.fileno(), [memoryview(head), memoryview(structure), *large])
    return len(head) + sum(sizes)


def receive(connection: Connection) -> Any:
    """Wait for what the other end sends, and return it; its arrays can be written to, and each has memory of its own.

    Raises
    ------
    EOFError
        The other end was closed.
    """
    fd = connection.fileno()
    (n,) = _COUNT.unpack(_read(fd, [_COUNT.size])[0])
    sizes = [_COUNT.unpack_from(head)[0] for head in _read(fd, [_COUNT.size] * n)]
    structure, *large = _read(fd, sizes)
    return pickle.loads(structure, buffers=large)


def _write(fd: int, pieces: Sequence[memoryview]) -> None:
    waiting = [piece for piece in pieces if piece.nbytes]
    begin = 0
    while begin < len(waiting):
        written = os.writev(fd, waiting[begin : begin + MAX_PIECES])
        while written and written >= waiting[begin].nbytes:
            written -= waiting[begin].nbytes
            begin += 1
            if begin == len(waiting):
                break
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
