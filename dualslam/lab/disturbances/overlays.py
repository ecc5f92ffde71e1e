"""Things that stand still in the image: a driver's cab, a bonnet, black bars, a logo, a clock."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.config.corruption import Corruption, CorruptionKind

U8Image = NDArray[np.uint8]

OVERLAYS = (
    CorruptionKind.CAB,
    CorruptionKind.BONNET,
    CorruptionKind.BARS,
    CorruptionKind.LOGO,
    CorruptionKind.CLOCK,
)
_CLOCK_FRAMES = 10
"""Frames after which the clock shows the next second."""
_COARSE_CELLS, _FINE_CELLS = 24, 96
"""Blocks of texture along the longer side of the image, of two sizes: corners for any detector."""


def overlay_mask(corruption: Corruption, size_px: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the pixels (H, W) that an overlay hides in images of a size (width, height)."""
    width, height = size_px
    share, mask = corruption.level, np.zeros((height, width), np.uint8)
    match corruption.kind:
        case CorruptionKind.CAB:  # a dashboard below and a pillar on each side
            top = round(height * (1 - 0.6 * share))
            pillar = round(0.2 * share * width * height / max(top, 1))
            mask[top:] = 1
            mask[:, :pillar] = mask[:, width - pillar :] = 1
        case CorruptionKind.BONNET:  # half an ellipse at the lower edge
            axes = (round(0.55 * width), round(2 * share * height / (0.55 * np.pi)))
            cv2.ellipse(mask, (width // 2, height), axes, 0, 0, 360, 1, -1)
        case CorruptionKind.BARS:
            bar = round(share * width / 2)
            mask[:, :bar] = mask[:, width - bar :] = 1
        case CorruptionKind.LOGO:  # an ellipse, twice as wide as high, near the upper right corner
            b = max(round(np.sqrt(share * width * height / (2 * np.pi))), 1)
            cv2.ellipse(mask, (width - round(2.4 * b), round(1.6 * b)), (2 * b, b), 0, 0, 360, 1, -1)
        case CorruptionKind.CLOCK:  # a box, six times as wide as high, near the lower left corner
            rows, columns = _clock_box(share, size_px)
            mask[rows, columns] = 1
        case _:
            raise ValueError(f"{corruption.kind} does not stand still in the image")
    return mask.astype(np.bool_)


def hidden_by(corruptions: Iterable[Corruption], size_px: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the pixels (H, W) that any of the overlays among some corruptions hides: the true mask."""
    hidden = np.zeros((size_px[1], size_px[0]), np.bool_)
    for corruption in corruptions:
        if corruption.kind in OVERLAYS:
            hidden |= overlay_mask(corruption, size_px)
    return hidden


def put_overlay(image: U8Image, corruption: Corruption, index: int) -> U8Image:
    """Return the image (H, W) or (H, W, 3) of frame `index` with an overlay put on it."""
    height, width = image.shape[:2]
    mask, rng = overlay_mask(corruption, (width, height)), np.random.Generator(np.random.SFC64(corruption.seed))
    match corruption.kind:
        case CorruptionKind.BARS:
            content = np.zeros((height, width), np.uint8)
        case CorruptionKind.BONNET:  # paint: soft, dark, little contrast
            content = _texture((width, height), rng, mean=70, contrast=25, blur_px=width / 320)
        case CorruptionKind.CLOCK:
            content = _clock_face(corruption, (width, height), index)
        case _:
            content = _texture((width, height), rng, mean=110, contrast=90, blur_px=width / 1280)
    out = image.copy()
    out[mask] = content[mask] if image.ndim == 2 else content[mask][:, None]
    return out


def _texture(
    size_px: tuple[int, int], rng: np.random.Generator, mean: float, contrast: float, blur_px: float
) -> U8Image:
    """Return random blocks of two sizes, softened, about a mean grey."""
    width, height = size_px
    total = np.full((height, width), mean, np.float32)
    for n_cells, share in ((_COARSE_CELLS, 0.6), (_FINE_CELLS, 0.4)):
        cell_px = max(max(size_px) // n_cells, 1)
        blocks = rng.uniform(-1, 1, (-(-height // cell_px), -(-width // cell_px))).astype(np.float32)
        total += share * contrast * np.kron(blocks, np.ones((cell_px, cell_px), np.float32))[:height, :width]
    return np.asarray(np.clip(cv2.GaussianBlur(total, (0, 0), max(blur_px, 0.3)), 0, 255), np.uint8)


def _clock_box(share: float, size_px: tuple[int, int]) -> tuple[slice, slice]:
    width, height = size_px
    side = max(round(np.sqrt(share * width * height / 6)), 1)
    return slice(height - 2 * side, height - side), slice(side, 7 * side)


def _clock_face(corruption: Corruption, size_px: tuple[int, int], index: int) -> U8Image:
    """Return the image of a clock: white digits in a dark box."""
    rows, columns = _clock_box(corruption.level, size_px)
    height, width = rows.stop - rows.start, columns.stop - columns.start
    seconds = 12 * 3600 + 34 * 60 + 50 + max(index - corruption.start, 0) // _CLOCK_FRAMES
    text = f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"
    (text_width, text_height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 1.0, 2)
    scale = min(0.9 * width / text_width, 0.7 * height / text_height)
    content = np.full((size_px[1], size_px[0]), 30, np.uint8)
    at = (columns.start + round(0.05 * width), rows.stop - round(0.15 * height))
    thickness = max(round(2 * scale), 1)
    cv2.putText(content, text, at, cv2.FONT_HERSHEY_SIMPLEX, scale, 230, thickness, cv2.LINE_AA)
    return content
