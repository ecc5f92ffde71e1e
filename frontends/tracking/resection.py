"""The pose of a camera from points and pixels, some of them wrong, without a first guess."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import poselib

from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import PoseEstimate, refine_pose
from dualslam.core.noise_model import GATE_SIGMAS
from dualslam.core.types import BoolArray, Failure, FloatArray

MIN_SAMPLE = 3
"""Points that fix a pose."""


class Resection(NamedTuple):
    """A pose found by RANSAC, and the points that agree with it."""

    T_cam_w: FloatArray  # (4, 4)
    inliers: BoolArray  # (N,)


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
) -> Resection:
    """RANSAC over the 3-point problem (PoseLib).

    - `K` (3, 3), `size_px` (width, height), `uv_px` (N, 2), rectified pixels, `xyz` (N, 3).
    - `sigma_px`: typical noise of the pixels; the inlier threshold is three times that.
    - `max_iterations`: hypotheses at most; a thousand find one where a sixth of the matches are right.
    """
    camera = poselib_camera(K, size_px)
    options: dict[str, Any] = {
        "max_reproj_error": GATE_SIGMAS * sigma_px,
        "max_iterations": max_iterations,
        "min_iterations": 50,
        "seed": seed,
    }
    pose, found = poselib.estimate_absolute_pose(uv_px, xyz, camera, options, {})
    return Resection(se3.from_parts(pose.R, pose.t), np.array(found["inliers"], np.bool_))


def estimate_pose(
    K: FloatArray,
    size_px: tuple[int, int],
    uv_px: FloatArray,
    xyz: FloatArray,
    sigma_px: FloatArray,
    seed: int,
    *,
    min_inliers: int = 6,
    tolerance: float = 1e-4,
) -> PoseEstimate | Failure:
    """Estimate a pose without a guess: RANSAC, then a refinement that starts from its inliers.

    - `K`, `size_px`, `uv_px`, `xyz`, `seed`: as for `resect`.
    - `sigma_px` (N,): standard deviation of each pixel coordinate.
    - `min_inliers`, `tolerance`: as for `refine_pose`.

    Returns PoseEstimate or Failure: as `refine_pose` returns it.
    """
    start = resect(K, size_px, uv_px, xyz, float(np.median(sigma_px)), seed)
    return refine_pose(
        K,
        start.T_cam_w,
        xyz,
        uv_px,
        sigma_px,
        min_inliers=min_inliers,
        tolerance=tolerance,
        consensus=start.inliers if start.inliers.sum() >= MIN_SAMPLE else None,
    )
