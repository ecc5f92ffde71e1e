"""Damage to the bytes of a file, by a seeded generator: what disks, transfers, editors and other programs do."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

NUMBER = re.compile(rb"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
WORD = re.compile(rb"[A-Za-z_]{2,}")
ODD_NUMBERS = (b"nan", b"inf", b"-inf", b"1e400", b"1e-320", b"0", b"-1", b"", b"1,5", b"0x10", b"abc", b"9" * 25)
ODD_WORDS = (b"null", b"true", b"[]", b"{}", b"!!python/object:os.system", b"*a", b"\xff\xfe", "größe".encode(), b"")
ODD_BYTES = (b"\0", b"\xef\xbb\xbf", b"\r\n", b"\xff", b"\n\n", b"\t", b'"', b"# ", b"{", b"\x1a")


def cut_off(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: rng.integers(len(data) + 1)]


def empty(data: bytes, rng: np.random.Generator) -> bytes:
    return b""


def flip_bits(data: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(data)
    for i in rng.integers(len(data), size=int(rng.choice([1, 3, 30]))):
        changed[i] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _span(data: bytes, rng: np.random.Generator) -> tuple[int, int]:
    begin, end = sorted(rng.integers(len(data) + 1, size=2).tolist())
    return begin, min(end, begin + int(rng.choice([1, 20, 1000])))


def delete_a_span(data: bytes, rng: np.random.Generator) -> bytes:
    begin, end = _span(data, rng)
    return data[:begin] + data[end:]


def repeat_a_span(data: bytes, rng: np.random.Generator) -> bytes:
    begin, end = _span(data, rng)
    return data[:end] + data[begin:]


def blank_a_span(data: bytes, rng: np.random.Generator) -> bytes:
    begin, end = _span(data, rng)
    return data[:begin] + bytes(end - begin) + data[end:]


def insert_odd_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    at = int(rng.integers(len(data) + 1))
    return data[:at] + ODD_BYTES[rng.integers(len(ODD_BYTES))] + data[at:]


def _replace_one(pattern: re.Pattern[bytes], odd: tuple[bytes, ...], data: bytes, rng: np.random.Generator) -> bytes:
    found = list(pattern.finditer(data))
    if not found:
        return flip_bits(data, rng)
    match = found[rng.integers(len(found))]
    return data[: match.start()] + odd[rng.integers(len(odd))] + data[match.end() :]


def replace_a_number(data: bytes, rng: np.random.Generator) -> bytes:
    return _replace_one(NUMBER, ODD_NUMBERS, data, rng)


def replace_a_word(data: bytes, rng: np.random.Generator) -> bytes:
    return _replace_one(WORD, ODD_WORDS, data, rng)


def move_a_line(data: bytes, rng: np.random.Generator) -> bytes:
    """Take a line out, or put it somewhere else, or twice."""
    lines = data.splitlines(keepends=True)
    line = lines.pop(rng.integers(len(lines)))
    for _ in range(int(rng.integers(3))):
        lines.insert(int(rng.integers(len(lines) + 1)), line)
    return b"".join(lines)


Mutation = Callable[[bytes, np.random.Generator], bytes]
OF_BYTES: tuple[Mutation, ...] = (
    cut_off,
    empty,
    flip_bits,
    delete_a_span,
    repeat_a_span,
    blank_a_span,
    insert_odd_bytes,
)
OF_TEXT: tuple[Mutation, ...] = (replace_a_number, replace_a_number, replace_a_number, replace_a_word, move_a_line)


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Return the data with one to three faults."""
    is_text = b"\0" not in data[:200] and data[:4] not in (b"\x89PNG", b"\xff\xd8\xff\xe0")
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        if not data:
            break
        kinds = OF_TEXT if is_text and rng.random() < 0.7 else OF_BYTES
        data = kinds[rng.integers(len(kinds))](data, rng)
    return data
