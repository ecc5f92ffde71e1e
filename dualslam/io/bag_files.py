"""The messages of ROS 1 bags, ROS 2 bags (SQLite) and MCAP, found by reading from the start: a cut end does no harm.

The index at the end of a bag is not used, so one that was cut off gives all that is before the cut.
"""

from __future__ import annotations

import bz2
import mmap
import os
import shutil
import sqlite3
import struct
import weakref
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from dualslam.core.errors import InputError, how_to_install

ROS1_MAGIC, MCAP_MAGIC, SQLITE_MAGIC = b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n", b"SQLite format 3\0"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""Of a file or a message that rosbag2 has packed. No message that is not packed begins with it."""
PACKED_BYTES = 2**20
"""That are unpacked at once."""


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag: its name, and its type as ROS 2 writes it (``sensor_msgs/msg/Image``)."""

    name: str
    type: str
    is_ros1: bool


@dataclass(frozen=True, slots=True)
class Place:
    """Where a message is: a slice of a file or of one of its chunks, or a row of a database."""

    file: int
    chunk: tuple[int, int, str] | None
    start: int
    stop: int


@dataclass(slots=True, weakref_slot=True)
class Bag:
    """Contents of a bag."""

    paths: list[Path]
    messages: dict[Topic, list[tuple[int, Place]]] = field(default_factory=dict)
    """dict of Topic to list of (time in nanoseconds, Place): by the times at which they were recorded."""
    is_whole: bool = True  # whether no file was cut off


def is_bag(path: Path) -> bool:
    """Whether a file begins as a bag."""
    try:
        with path.open("rb") as file:
            start = file.read(16)
    except OSError:
        return False
    return start.startswith((ROS1_MAGIC, MCAP_MAGIC, ZSTD_MAGIC)) or start == SQLITE_MAGIC


def scan(paths: list[Path]) -> Bag:
    """Find the messages of the files of a bag.

    Raises `InputError` if one is no bag, or `rosbags` and what it unpacks by are not installed.
    """
    if find_spec("rosbags") is None:
        raise InputError(f"Bags are read by rosbags, which is not installed: {how_to_install('bags')}.")
    bag = Bag(paths)
    for number, path in enumerate(paths):
        magic = _magic(path, path)
        if magic.startswith(ZSTD_MAGIC):
            bag.is_whole &= _unpack_file(bag, number)
            magic = _magic(bag.paths[number], path)
        if magic == SQLITE_MAGIC[:8]:
            _scan_sqlite(bag, number)
            continue
        reader = _scan_mcap if magic == MCAP_MAGIC else _scan_ros1
        with bag.paths[number].open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            bag.is_whole &= reader(bag, number, data)
    return bag


def _magic(path: Path, named: Path) -> bytes:
    """Return the first bytes of a file of a bag. `named`: what a user calls it, in the message."""
    if not is_bag(path):
        raise InputError(f"{named} is no ROS bag and no MCAP file; give a .bag, a .mcap or a .db3 file.")
    with path.open("rb") as file:
        return file.read(8)


class BagReader:
    """Reads messages of a bag by their places; keeps the last chunk that it has unpacked."""

    def __init__(self, paths: list[Path]) -> None:
        self._paths = paths
        self._open: dict[int, Any] = {}
        self._key: tuple[int, Any] | None = None
        self._chunk = b""

    def read(self, place: Place) -> bytes:
        """Return the bytes of a message."""
        data = self._stored(place)
        return _unpacked(data, "zstd") if data.startswith(ZSTD_MAGIC) else data

    def _stored(self, place: Place) -> bytes:
        if place.file not in self._open:
            path = self._paths[place.file]
            self._open[place.file] = path.open("rb") if place.stop >= 0 else _connect(path)
        opened = self._open[place.file]
        if place.stop < 0:
            row = opened.execute("SELECT data FROM messages WHERE id = ?", (place.start,)).fetchone()
            return bytes(row[0])
        if place.chunk is None:
            opened.seek(place.start)
            return bytes(opened.read(place.stop - place.start))
        if self._key != (place.file, place.chunk):
            start, stop, packing = place.chunk
            opened.seek(start)
            self._chunk = _unpacked(opened.read(stop - start), packing)
            self._key = place.file, place.chunk
        return self._chunk[place.start : place.stop]

    def close(self) -> None:
        """Close the files."""
        for opened in self._open.values():
            opened.close()
        self._open.clear()


def _unpacked(data: bytes, packing: str) -> bytes:
    """Return a chunk's content; of one that was cut off, what is before the cut."""
    if packing in ("", "none"):
        return data
    try:
        if packing == "bz2":
            return bz2.BZ2Decompressor().decompress(data)
        if packing == "lz4":
            from lz4.frame import LZ4FrameDecompressor

            return bytes(LZ4FrameDecompressor().decompress(data))
        if packing == "zstd":
            return bytes(_zstd().ZstdDecompressor().decompress(data))
    except (OSError, EOFError, RuntimeError, ValueError, _zstd().ZstdError):
        return b""
    raise InputError(f"the bag's chunks are packed as {packing!r}; pack them by lz4, zstd or bz2, or not at all.")


def _zstd() -> Any:
    """Return the module: Python's from 3.14 on, before that what `rosbags` brings."""
    try:
        from compression import zstd
    except ImportError:
        from backports import zstd
    return zstd


def _unpack_file(bag: Bag, number: int) -> bool:
    """Give a bag an unpacked copy of a file; return whether the packed one was whole."""
    path, unpacker = bag.paths[number], _zstd().ZstdDecompressor()
    copy = _folder_of(bag) / path.stem
    with path.open("rb") as packed, copy.open("wb") as out, suppress(_zstd().ZstdError):
        while not unpacker.eof and (data := packed.read(PACKED_BYTES)):
            out.write(unpacker.decompress(data))
    bag.paths[number] = copy
    return bool(unpacker.eof)


def _folder_of(bag: Bag) -> Path:
    """Make a folder that goes when the bag does."""
    folder = mkdtemp(prefix="dualslam-bag-")
    weakref.finalize(bag, shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def _note(bag: Bag, topic: Topic | None, time_ns: int, place: Place) -> None:
    if topic is not None:
        bag.messages.setdefault(topic, []).append((time_ns, place))


# --- MCAP: mcap.dev/spec


def _mcap_records(data: Any, start: int) -> Iterator[tuple[int, int, int, bool]]:
    """Yield each record's opcode, the start and the stop of its content, and whether it is whole."""
    end = len(data)
    while start + 9 <= end:
        op, length = data[start], struct.unpack_from("<Q", data, start + 1)[0]
        content, stop = start + 9, start + 9 + length
        yield op, content, min(stop, end), stop <= end
        start = stop


def _scan_mcap(bag: Bag, number: int, data: Any) -> bool:
    schemas: dict[int, str] = {}
    topics: dict[int, Topic | None] = {}
    ended = False

    def take(op: int, start: int, stop: int, inside: Any, chunk: tuple[int, int, str] | None) -> None:
        record = bytes(inside[start : min(stop, start + 4096)])
        if op == 3:
            schemas[struct.unpack_from("<H", record)[0]] = _string(record, 2)[0]
        elif op == 4:
            channel, schema = struct.unpack_from("<HH", record)
            name, at = _string(record, 4)
            encoding, _ = _string(record, at)
            known = encoding in ("cdr", "ros1") and schema in schemas
            topics[channel] = Topic(name, _ros2_type(schemas[schema]), encoding == "ros1") if known else None
        elif op == 5 and stop - start >= 22:
            channel, _, log_ns = struct.unpack_from("<HIQ", record)
            _note(bag, topics.get(channel), log_ns, Place(number, chunk, start + 22, stop))

    for op, start, stop, is_whole in _mcap_records(data, len(MCAP_MAGIC)):
        if op == 6 and stop - start > 40:
            packing, at = _string(bytes(data[start + 28 : start + 64]), 0)
            begin = start + 28 + at + 8
            inside = _unpacked(bytes(data[begin:stop]), packing)
            for inner, a, b, inner_whole in _mcap_records(inside, 0):
                if inner_whole:
                    take(inner, a, b, inside, (begin, stop, packing))
        elif is_whole:
            take(op, start, stop, data, None)
        ended |= op in (2, 15) and is_whole
    return ended


def _string(record: bytes, at: int) -> tuple[str, int]:
    """Return a string with its length before it, and where it ends."""
    (length,) = struct.unpack_from("<I", record, at)
    return record[at + 4 : at + 4 + length].decode("utf-8", "replace"), at + 4 + length


def _ros2_type(name: str) -> str:
    return name if name.count("/") != 1 else name.replace("/", "/msg/")


# --- ROS 1: wiki.ros.org/Bags/Format/2.0


def _ros1_records(data: Any, start: int) -> Iterator[tuple[dict[str, bytes], int, int, bool]]:
    """Yield the fields of each record's header, the start and the stop of its data, and whether it is whole."""
    end = len(data)
    while start + 8 <= end:
        (n_header,) = struct.unpack_from("<I", data, start)
        header = start + 4 + n_header
        if header + 4 > end:
            return
        fields = _ros1_fields(bytes(data[start + 4 : header]))
        (length,) = struct.unpack_from("<I", data, header)
        yield fields, header + 4, min(header + 4 + length, end), header + 4 + length <= end
        start = header + 4 + length


def _ros1_fields(header: bytes) -> dict[str, bytes]:
    fields, at = {}, 0
    while at + 4 <= len(header):
        (length,) = struct.unpack_from("<I", header, at)
        name, _, value = header[at + 4 : at + 4 + length].partition(b"=")
        fields[name.decode("latin-1")] = value
        at += 4 + length
    return fields


def _scan_ros1(bag: Bag, number: int, data: Any) -> bool:
    topics: dict[bytes, Topic] = {}
    n_indexed = 0

    def take(fields: dict[str, bytes], a: int, b: int, inside: Any, chunk: tuple[int, int, str] | None) -> None:
        op = fields.get("op")
        if op == b"\x07" and "conn" in fields:
            said = _ros1_fields(bytes(inside[a:b]))
            name, its_type = fields.get("topic", b"").decode(), said.get("type", b"").decode()
            topics[fields["conn"]] = Topic(name, _ros2_type(its_type), True)
        elif op == b"\x02" and len(fields.get("time", b"")) == 8:
            seconds, rest = struct.unpack("<II", fields["time"])
            _note(bag, topics.get(fields.get("conn", b"")), seconds * 10**9 + rest, Place(number, chunk, a, b))

    for fields, start, stop, is_whole in _ros1_records(data, len(ROS1_MAGIC)):
        if fields.get("op") == b"\x05":
            packing = fields.get("compression", b"none").decode()
            inside = _unpacked(bytes(data[start:stop]), packing)
            for inner, a, b, inner_whole in _ros1_records(inside, 0):
                if inner_whole:
                    take(inner, a, b, inside, (start, stop, packing))
        elif is_whole:
            take(fields, start, stop, data, None)
            n_indexed += fields.get("op") == b"\x06"
    return n_indexed > 0


# --- ROS 2 in SQLite


def _connect(path: Path) -> sqlite3.Connection:
    # Readers are used by one thread each, but not always by the one that closes them.
    return sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True, check_same_thread=False)


def _scan_sqlite(bag: Bag, number: int) -> None:
    path, is_whole = bag.paths[number], _pad(bag, number)
    database = _connect(bag.paths[number])
    found: list[tuple[Topic | None, int, Place]] = []
    try:
        rows = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        topics = {i: Topic(name, _ros2_type(kind), False) for i, name, kind, form in rows if form == "cdr"}
        for i, topic_id, time_ns in database.execute("SELECT id, topic_id, timestamp FROM messages"):
            found.append((topics.get(topic_id), time_ns, Place(number, None, i, -1)))
    except sqlite3.DatabaseError as error:
        is_whole = False
        if not found:
            raise InputError(f"{path} is no ROS 2 bag that can be read: {error}.") from error
    if not is_whole:
        found = [message for message in found if _has_data(database, message[2].start)]
    database.close()
    for topic, time_ns, place in found:
        _note(bag, topic, time_ns, place)
    bag.is_whole &= is_whole


def _pad(bag: Bag, number: int) -> bool:
    """Give a copy of a database that was cut off its length, as SQLite reads no shorter one; return if it was whole."""
    path = bag.paths[number]
    with path.open("rb") as file:
        header = file.read(100)
    page = struct.unpack_from(">H", header, 16)[0]
    page = 65536 if page == 1 else max(page, 512)
    wanted, size = struct.unpack_from(">I", header, 28)[0] * page, path.stat().st_size
    if size >= wanted:
        return True
    copy = _folder_of(bag) / path.name
    shutil.copyfile(path, copy)
    os.truncate(copy, size // page * page)
    os.truncate(copy, wanted)
    bag.paths[number] = copy
    return False


def _has_data(database: sqlite3.Connection, row: int) -> bool:
    try:
        return database.execute("SELECT data FROM messages WHERE id = ?", (row,)).fetchone() is not None
    except sqlite3.DatabaseError:
        return False
