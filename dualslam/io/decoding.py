"""Image files to pixels of eight bits, of sources that use fewer bits than their files have room for.

Cameras of 10, 12 or 14 bits write files of 16. What is found holds for the whole source, so that images do not flicker.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

log = logging.getLogger(__name__)

WHOLE = 16
DEPTHS = (8, 10, 12, 14, WHOLE)
"""That cameras have."""
N_LOOKED_AT = 20
"""Images, evenly from the whole source: one of them is as bright as any will be."""
_JPEG, _PNG, _PNG_DEPTH_AT = b"\xff\xd8\xff", b"\x89PNG", 24
# How the files of a format end; a file without its ending was cut off, which decoders fill with grey and do not tell.
_ENDINGS = {_JPEG: b"\xff\xd9", _PNG: b"IEND\xaeB`\x82"}
_TAIL_BYTES = 1024
# A JPEG's thumbnail, which has an ending of its own, is in its first 64 KiB. Behind the image there may be more: phones
# append a film.
_HEAD_BYTES = 1 << 16


class UnreadableImageError(Exception):
    """One image of a sequence cannot be had. Its message is the sentence that the frame carries; reading goes on."""


def used_bits(n: int, values: Callable[[int], NDArray[Any] | None], name: str) -> int:
    """Return the number of bits that `n` images of a source use; `WHOLE` if their files have eight.

    - `values`: gives those of one image at their own depth, or None; may raise `UnreadableImageError`.
    - `name`: of the source. A warning names it if fewer than `WHOLE` bits are used.
    """
    brightest = -1
    for index in np.linspace(0, n - 1, min(n, N_LOOKED_AT)).astype(int).tolist():
        try:
            image = values(index)
        except UnreadableImageError:  # reported where the frame is read
            continue
        if image is not None and image.dtype != np.uint16:
            return WHOLE
        brightest = max(brightest, -1 if image is None else int(image.max()))
    if brightest < 0:
        return WHOLE
    bits = next(depth for depth in DEPTHS if brightest < 1 << depth)
    if bits < WHOLE:
        log.warning("%s: its images of 16 bits use %d of them, and are read as images of %d bits", name, bits, bits)
    return bits


def file_values(data: bytes) -> NDArray[Any] | None:
    """Return a file's values at their own depth; an empty array of bytes if its head says that they have eight bits."""
    if data.startswith(_JPEG) or (data.startswith(_PNG) and data[_PNG_DEPTH_AT : _PNG_DEPTH_AT + 1] != b"\x10"):
        return np.zeros(0, np.uint8)
    return _decoded(data, cv2.IMREAD_UNCHANGED) if data else None


def upper_eight(pixels: NDArray[Any], bits: int) -> NDArray[np.uint8]:
    """Return the upper eight of the bits that are used; what is brighter is white."""
    return np.minimum(pixels >> (bits - 8), 255).astype(np.uint8)


def decode(data: bytes, name: str, grey: bool, bits: int = WHOLE) -> NDArray[np.uint8]:
    """Decode a file's bytes to (H, W) grey or (H, W, 3) RGB.

    `name` is for the message of `UnreadableImageError`; `bits`: how many of 16 the source uses (`used_bits`).
    """
    if not data:
        raise UnreadableImageError(f"{name} is empty.")
    for start, end in _ENDINGS.items():
        if data.startswith(start) and end not in data[-_TAIL_BYTES:] and data.find(end, _HEAD_BYTES) < 0:
            raise UnreadableImageError(f"{name} is cut off: its end is missing.")
    flags = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR
    image = None if bits == WHOLE else _decoded(data, flags | cv2.IMREAD_ANYDEPTH)
    image = _decoded(data, flags) if image is None or image.dtype != np.uint16 else upper_eight(image, bits)
    if image is None:
        values = _decoded(data, cv2.IMREAD_UNCHANGED)
        if values is not None and values.dtype not in (np.uint8, np.uint16):
            raise UnreadableImageError(
                f"{name} has values of type {values.dtype}; write it as an image of 8 or 16 bits."
            )
        raise UnreadableImageError(f"{name} cannot be decoded: it is damaged or no image.")
    return np.asarray(image if grey else cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def _decoded(data: bytes, flags: int) -> NDArray[Any] | None:
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        return None
