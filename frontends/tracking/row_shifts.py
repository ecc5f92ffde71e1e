"""Where a pixel would be had all rows of its image been read at the time of the middle one, and back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dualslam.core.camera.base import Camera
from dualslam.core.geometry import so3
from dualslam.core.noise_model import TINY
from dualslam.core.types import Features, FloatArray


def correct_shutter(
    features: Features, camera: Camera, turn_rad: FloatArray, read_v_px: FloatArray | None = None
) -> Features:
    """Move features to where they would be had all rows been read at the time of the middle one.

    - `features`: as found in an image that was read row by row.
    - `turn_rad` (3,): rotation vector by which the camera turns while an image is read, in its own axes.
    - `read_v_px` (N,): rows in which the features were read, where `features` does not tell.
    """
    read_v_px = features.uv_px[:, 1] if read_v_px is None else read_v_px
    (uv_rect_px,) = at_mid_row(features.uv_rect_px, read_v_px, camera, turn_rad)
    # The found pixels move alike, so that the same features can be rectified again by a better camera.
    return replace(features, uv_px=features.uv_px + uv_rect_px - features.uv_rect_px, uv_rect_px=uv_rect_px)


def _turned(rays: FloatArray, share: FloatArray, turn_rad: FloatArray) -> FloatArray:
    """Turn each ray (N, 3) by its share (N,) of a turn (3,), by Rodrigues' formula: N matrices take thrice as long."""
    angle_rad = float(np.linalg.norm(turn_rad))
    axis = turn_rad / max(angle_rad, TINY)
    across = rays @ so3.hat(axis).T
    by = share * angle_rad
    # 1 - cos as a square: small turns keep their digits.
    inwards = across @ so3.hat(axis).T
    return np.asarray(rays + np.sin(by)[:, None] * across + (2 * np.sin(0.5 * by) ** 2)[:, None] * inwards, np.float64)


def at_mid_row(
    uv_rect_px: FloatArray, read_v_px: FloatArray, camera: Camera, *turns_rad: FloatArray
) -> list[FloatArray]:
    """Return rectified pixels (N, 2), read in rows (N,), as they would be at the time of the middle row.

    For each of several turns (3,) of the camera while an image is read, in its own axes.
    """
    K = camera.K
    f, c = np.diag(K)[:2], K[:2, 2]
    rays = np.column_stack([(uv_rect_px - c) / f, np.ones(len(uv_rect_px))])
    share = read_v_px / camera.height - 0.5
    turned = (_turned(rays, share, turn_rad) for turn_rad in turns_rad)
    return [np.asarray(f * each[:, :2] / each[:, 2:] + c, np.float64) for each in turned]


def straighten(uv_px: FloatArray, camera: Camera, turn_rad: FloatArray) -> FloatArray:
    """Return where things that an image shows at pixels (N, 2) are in the features: as `correct_shutter` moves them."""
    uv_rect_px, _ = camera.rectify(uv_px)
    (moved_px,) = at_mid_row(uv_rect_px, uv_px[:, 1], camera, turn_rad)
    return uv_px + moved_px - uv_rect_px


def find_as_read(uv_px: FloatArray, uv_rect_px: FloatArray, camera: Camera, turn_rad: FloatArray) -> FloatArray:
    """Return where an image shows what features have at pixels (N, 2), and rectified: inverse of `straighten`."""
    read_px = uv_px
    # Each was read in a row that is known once it is put back: a second time, it is.
    for _ in range(2):
        (moved_px,) = at_mid_row(uv_rect_px, read_px[:, 1], camera, -turn_rad)
        read_px = uv_px + moved_px - uv_rect_px
    return read_px
