"""Image corruptions: the same frame and seed give the same pixels, in any order."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.config.corruption import Corruption, CorruptionKind
from dualslam.lab.disturbances.overlays import OVERLAYS, put_overlay

U8Image = NDArray[np.uint8]

_GAMMA = 2.2  # display values are about the light to the power 1/2.2
_REFERENCE_WIDTH = 640  # strengths in pixels are for images of this width
_PATCH_CELL_PX = 6  # the coarsest texture of a moving patch: corners for any detector


def corrupt_image(image: U8Image, corruption: Corruption, index: int) -> U8Image:
    """Return the image (H, W) or (H, W, 3) of frame `index` as a corruption leaves it.

    Parameters
    ----------
    image : ndarray
        Not changed.
    corruption : Corruption
        Of a kind that disturbs images; one that covers the frame.
    index : int
    """
    level = corruption.level
    if corruption.kind in OVERLAYS:
        return put_overlay(image, corruption, index)
    match corruption.kind:
        case CorruptionKind.WIPE:
            return _wipe(image, level)
        case CorruptionKind.OCCLUSION:
            return _occlude(image, corruption, index)
        case CorruptionKind.BLUR:
            sigma_px = level * image.shape[1] / _REFERENCE_WIDTH
            return image if sigma_px == 0 else np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), np.uint8)
        case CorruptionKind.MOTION_BLUR:
            return _shake(image, level * image.shape[1] / _REFERENCE_WIDTH, _rng(corruption, index))
        case CorruptionKind.BLACKOUT:
            return _expose(image, 1.0 - level)
        case CorruptionKind.EXPOSURE:
            return _expose(image, 2.0**level)
        case CorruptionKind.NOISE:
            grain = _rng(corruption, index).standard_normal(image.shape, dtype=np.float32)
            return np.asarray(cv2.addWeighted(image.astype(np.float32), 1, grain, level, 0, dtype=cv2.CV_8U), np.uint8)
    raise ValueError(f"{corruption.kind} does nothing to an image")


def _rng(corruption: Corruption, index: int) -> np.random.Generator:
    return np.random.Generator(np.random.SFC64([corruption.seed, list(CorruptionKind).index(corruption.kind), index]))


def _expose(image: U8Image, light: float) -> U8Image:
    return np.asarray(cv2.convertScaleAbs(image, alpha=light ** (1 / _GAMMA)), np.uint8)


def _wipe(image: U8Image, fraction: float) -> U8Image:
    """Coarse shading remains: fog or a blank wall is lit unevenly too."""
    height, width = image.shape[:2]
    flat = cv2.resize(cv2.resize(image, (6, 4), interpolation=cv2.INTER_AREA), (width, height))
    flat = cv2.GaussianBlur(flat, (0, 0), width / 20)
    return np.asarray(cv2.addWeighted(image, 1 - fraction, flat, fraction, 0), np.uint8)


def _shake(image: U8Image, length_px: float, rng: np.random.Generator) -> U8Image:
    """Smear along a line in a direction of its own for each frame."""
    half = int(np.ceil(length_px / 2))
    if half == 0:
        return image
    angle_rad = rng.uniform(0, np.pi)
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    along = np.linspace(-length_px / 2, length_px / 2, 4 * half + 1)
    column, row = half + along * np.cos(angle_rad), half + along * np.sin(angle_rad)
    np.add.at(kernel, (np.rint(row).astype(int), np.rint(column).astype(int)), 1.0)
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE), np.uint8)


def _occlude(image: U8Image, corruption: Corruption, index: int) -> U8Image:
    """Move a textured square from one side of the image to the other while the corruption lasts."""
    height, width = image.shape[:2]
    rng = np.random.Generator(np.random.SFC64([corruption.seed, 0x0CC1]))
    side_px = min(int(np.sqrt(corruption.level * height * width)), 4 * max(height, width))
    if side_px == 0:
        return image
    patch = _texture(side_px, rng)
    # Without an end it goes to and fro, a crossing in 60 frames.
    length = corruption.length or 60
    phase = ((index - corruption.start) % length + 0.5) / length
    phase = phase if rng.random() < 0.5 else 1 - phase
    # It stays at least half inside, so that its share of the image holds over the whole crossing.
    left = round((width - side_px) * phase) if side_px < width else (width - side_px) // 2
    top = round(rng.uniform(0, 1) * (height - side_px)) if side_px < height else (height - side_px) // 2
    out = image.copy()
    rows, columns = slice(max(top, 0), min(top + side_px, height)), slice(max(left, 0), min(left + side_px, width))
    seen = patch[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
    out[rows, columns] = seen if image.ndim == 2 else seen[:, :, None]
    return out


def _texture(side_px: int, rng: np.random.Generator) -> U8Image:
    """Return random blocks of two sizes: it moves as one piece, and detectors like it."""
    total = np.zeros((side_px, side_px), np.float32)
    for cell_px, contrast in ((4 * _PATCH_CELL_PX, 70), (_PATCH_CELL_PX, 50)):
        n = -(-side_px // cell_px)
        blocks = rng.uniform(-contrast, contrast, (n, n)).astype(np.float32)
        total += np.kron(blocks, np.ones((cell_px, cell_px), np.float32))[:side_px, :side_px]
    return np.asarray(np.clip(128 + total, 0, 255), np.uint8)
