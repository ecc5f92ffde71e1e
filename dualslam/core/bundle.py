"""Bundle adjustment between front ends and back end: the problem, its solution, who solves it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from dualslam.core.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class BundleProblem:
    """Poses, points and what was seen.

    Attributes
    ----------
    K : (3, 3)
    T_submap_kf : (F, 4, 4)
    fixed : (F,) bool
        Poses that stay. One fixes the pose of the whole, two its scale too.
    xyz_mu : (P, 3)
    kf, point : (R,) int64
        Rows of `T_submap_kf` and `xyz_mu` of each observation.
    uv_px : (R, 2)
    sigma_px : (R,)
    """

    K: FloatArray
    T_submap_kf: FloatArray
    fixed: BoolArray
    xyz_mu: FloatArray
    kf: IntArray
    point: IntArray
    uv_px: FloatArray
    sigma_px: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FrameRows:
    """Observations of a submap by frames that are no keyframes.

    Attributes
    ----------
    T_submap_cam : (F, 4, 4)
    frame : (R,) int64
        Row of `T_submap_cam` of each observation.
    landmark_ids : (R,) int64
    uv_px : (R, 2)
        Rectified.
    sigma_px : (R,)
    """

    T_submap_cam: FloatArray
    frame: IntArray
    landmark_ids: IntArray
    uv_px: FloatArray
    sigma_px: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class BundleResult:
    """The solution of a `BundleProblem`.

    Attributes
    ----------
    T_submap_kf : (F, 4, 4)
    xyz_mu : (P, 3)
    adjusted : (P,) bool
        False for points left as they were: fewer than two views in front of a camera, or views along one line.
    chi2 : (R,) float64
        Squared whitened residual of each observation; infinite where its point is behind the camera.
    cost_before, cost_after : float
        Sum of the Huber losses.
    """

    T_submap_kf: FloatArray
    xyz_mu: FloatArray
    adjusted: BoolArray
    chi2: FloatArray
    cost_before: float
    cost_after: float


class BundleAdjuster(Protocol):
    """Batch bundle adjustment, robust. Raises `SolverError` where the solver fails."""

    def __call__(self, problem: BundleProblem) -> BundleResult:
        """Adjust all poses that are not fixed, and all points."""
        ...
