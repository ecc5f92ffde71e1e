"""The pose of a camera from points and pixels, some of them wrong, without a first guess."""

from __future__ import annotations

from typing import Any

import numpy as np
import poselib

from dualslam.core.types import FloatArray


def poselib_camera(K: FloatArray, size_px: tuple[int, int]) -> dict[str, Any]:
    """Return the pinhole camera of rectified pixels as PoseLib takes it."""
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    return {"model": "PINHOLE", "width": size_px[0], "height": size_px[1], "params": params}


def resect(
    K: FloatArray,
    size_px: tuple[int, int],
    uv_px: FloatArray,
    xyz: FloatArray,
    sigma_px: float,
    seed: int,
    max_iterations: int = 1000,
) -> FloatArray:
    """RANSAC over the 3-point problem (PoseLib), a starting point for `refine_pose`.

    Parameters
    ----------
    K : (3, 3) float64
    size_px : (width, height)
    uv_px : (N, 2) float64, rectified pixels
    xyz : (N, 3) float64
    sigma_px : float
        Typical noise of the pixels; the inlier threshold is three times that.
    seed : int
    max_iterations : int
        Hypotheses at most; a thousand find one where a sixth of the matches are right.

    Returns
    -------
    (4, 4) float64
        ``T_cam_w``.
    """
    camera = poselib_camera(K, size_px)
    options: dict[str, Any] = {
        "max_reproj_error": 3.0 * sigma_px,
        "max_iterations": max_iterations,
        "min_iterations": 50,
        "seed": seed,
    }
    pose, _ = poselib.estimate_absolute_pose(uv_px, xyz, camera, options, {})
    T_cam_w = np.eye(4)
    T_cam_w[:3] = pose.Rt
    return T_cam_w
