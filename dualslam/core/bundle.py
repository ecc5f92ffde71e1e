"""Bundle adjustment between front ends and back end: the problem, its solution, who solves it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from dualslam.core.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class BundleProblem:
    """Poses, points and what was seen."""

    K: FloatArray  # (3, 3)
    T_submap_kf: FloatArray  # (F, 4, 4)
    fixed: BoolArray
    """(F,): poses that stay. One fixes the pose of the whole, two its scale too."""
    xyz_mu: FloatArray  # (P, 3)
    # Rows of `T_submap_kf` and `xyz_mu` of each observation.
    kf: IntArray  # (R,)
    point: IntArray  # (R,)
    uv_px: FloatArray  # (R, 2)
    sigma_px: FloatArray  # (R,)


@dataclass(frozen=True, slots=True, eq=False)
class FrameRows:
    """Observations of a submap by frames that are no keyframes."""

    T_submap_cam: FloatArray  # (F, 4, 4)
    frame: IntArray  # (R,): row of `T_submap_cam` of each observation
    landmark_ids: IntArray  # (R,)
    uv_px: FloatArray  # (R, 2): rectified
    sigma_px: FloatArray  # (R,)


@dataclass(frozen=True, slots=True, eq=False)
class BundleResult:
    """The solution of a `BundleProblem`."""

    T_submap_kf: FloatArray  # (F, 4, 4)
    xyz_mu: FloatArray  # (P, 3)
    adjusted: BoolArray
    """(P,): false for points left as they were: fewer than two views in front of a camera, or views along one line."""
    chi2: FloatArray
    """(R,): squared whitened residual of each observation; infinite where its point is behind the camera."""
    # Sum of the Huber losses.
    cost_before: float
    cost_after: float


BundleAdjuster = Callable[[BundleProblem], BundleResult]
"""Adjusts all poses that are not fixed, and all points, robustly. Raises `SolverError` where the solver fails."""
