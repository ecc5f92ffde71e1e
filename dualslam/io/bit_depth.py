"""How many bits the images of a source use, where their files have room for 16.

Cameras of 10, 12 or 14 bits write files of 16. Read by their upper eight bits these would be nearly black; read each by
its own brightest pixel, they would flicker. What is found holds for the whole source, whatever part of it is read.
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
_PNG, _PNG_DEPTH_AT = b"\x89PNG", 24
_JPEG = b"\xff\xd8\xff"


def used_bits(n: int, read: Callable[[int], bytes | None], name: str) -> int:
    """Return the number of bits that the images of a source use; `WHOLE` where their files have eight.

    - `n`: how many there are.
    - `read`: gives the bytes of one; None where it cannot be read.
    - `name`: of the source, for the message.
    """
    brightest = -1
    for index in looked_at(n):
        data = read(index)
        if not data:
            continue
        if _has_eight(data):
            return WHOLE
        image = _decoded(data, cv2.IMREAD_UNCHANGED)
        if image is None:
            continue
        if image.dtype != np.uint16:
            return WHOLE
        brightest = max(brightest, int(image.max()))
    return depth_of(brightest, name)


def looked_at(n: int) -> list[int]:
    """Return the indices of `N_LOOKED_AT` of `n` images, evenly from all."""
    return np.linspace(0, n - 1, min(n, N_LOOKED_AT)).astype(int).tolist()


def depth_of(brightest: int, name: str) -> int:
    """Return the least depth of a camera that has a value as bright, and say so where it is below `WHOLE`."""
    if brightest < 0:
        return WHOLE
    bits = next(depth for depth in DEPTHS if brightest < 1 << depth)
    if bits < WHOLE:
        log.warning("%s: its images of 16 bits use %d of them, and are read as images of %d bits", name, bits, bits)
    return bits


def decoded(data: bytes, grey: bool, bits: int = WHOLE) -> NDArray[np.uint8] | None:
    """Decode a file's bytes to (H, W) grey or (H, W, 3) BGR, from the upper eight of the bits that are used.

    What is brighter is white. None where it cannot be decoded, or not to eight bits.
    """
    flags = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR
    if bits == WHOLE:
        return _decoded(data, flags)  # type: ignore[return-value]
    image = _decoded(data, flags | cv2.IMREAD_ANYDEPTH)
    if image is None or image.dtype != np.uint16:
        return _decoded(data, flags)  # type: ignore[return-value]
    return upper_eight(image, bits)


def upper_eight(pixels: NDArray[Any], bits: int) -> NDArray[np.uint8]:
    """Return the upper eight of the bits that are used; what is brighter is white."""
    return np.minimum(pixels >> (bits - 8), 255).astype(np.uint8)


def other_type(data: bytes) -> str | None:
    """Return the type of an image's values where it is one that is not read, such as ``float32``."""
    image = _decoded(data, cv2.IMREAD_UNCHANGED)
    return None if image is None or image.dtype in (np.uint8, np.uint16) else str(image.dtype)


def _has_eight(data: bytes) -> bool:
    """Whether a file says of itself that its values have eight bits."""
    return data.startswith(_JPEG) or (data.startswith(_PNG) and data[_PNG_DEPTH_AT : _PNG_DEPTH_AT + 1] != b"\x10")


def _decoded(data: bytes, flags: int) -> NDArray[np.uint8] | NDArray[np.uint16] | None:
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        return None
