"""Focal length in a photograph's EXIF data."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from PIL import ExifTags, Image, UnidentifiedImageError

DIAGONAL_35MM = 43.267
"""Of the 36 x 24 mm frame that equivalent focal lengths refer to."""
MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0}
"""Of `FocalPlaneResolutionUnit`: inch, centimetre, millimetre."""
LIKELY = (0.3, 20.0)
"""Focal lengths over the image's longer side that a lens may have; anything else is a mistake."""
SIGMA = 0.05
"""Of its logarithm: whole millimetres of 26 leave 2 %, and diagonal or width, whichever is meant, 4 %."""
SAME_SHAPE = 0.02
"""Relative difference of two aspect ratios up to which an image has only been scaled, not cropped."""


def focal_over_longer_side(path: Path) -> float | None:
    """Return a photograph's focal length in pixels, over the longer side of its image.

    By the pitch of the sensor's pixels if known, else by the equivalent focal length of a 35 mm camera. None if neither
    is known, the file is no photograph, or it was cropped since.
    """
    try:
        with Image.open(path) as image:
            width, height = image.size
            told: Mapping[int, Any] = image.getexif().get_ifd(ExifTags.IFD.Exif)
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError):
        return None
    tag = ExifTags.Base
    taken = _number(told, tag.ExifImageWidth), _number(told, tag.ExifImageHeight)
    if taken[0] and taken[1] and abs(_aspect(taken[0], taken[1]) / _aspect(width, height) - 1.0) > SAME_SHAPE:
        return None
    focal_mm, pixels_per_unit = _number(told, tag.FocalLength), _number(told, tag.FocalPlaneXResolution)
    mm = MM_PER_UNIT.get(int(_number(told, tag.FocalPlaneResolutionUnit) or 2))
    if focal_mm and pixels_per_unit and mm and taken[0] and taken[1]:
        ratio = focal_mm * pixels_per_unit / mm / max(taken[0], taken[1])
    elif equivalent_mm := _number(told, tag.FocalLengthIn35mmFilm):
        ratio = over_longer_side(equivalent_mm, width, height)
    else:
        return None
    return ratio if is_likely(ratio) else None


def over_longer_side(equivalent_mm: float, width: float, height: float) -> float:
    """Return the focal length over an image's longer side that belongs to one of a 36 x 24 mm camera."""
    return equivalent_mm / DIAGONAL_35MM * math.hypot(width, height) / max(width, height)


def is_likely(ratio: float) -> bool:
    """Whether a lens may have this focal length, over the image's longer side."""
    return LIKELY[0] < ratio < LIKELY[1]


def _number(told: Mapping[int, Any], tag: int) -> float | None:
    """Return a tag's value; None where it is missing, or no finite positive number."""
    try:
        value = float(told[tag])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    return value if math.isfinite(value) and value > 0 else None


def _aspect(width: float, height: float) -> float:
    return max(width, height) / min(width, height)
