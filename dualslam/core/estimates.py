"""Values of the interfaces: estimates of a graph, camera and shutter, and a keyframe's effect on the map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dualslam.core.types import FloatArray, IntArray

if TYPE_CHECKING:
    from dualslam.core.camera.corrected import LensCorrection


@dataclass(frozen=True, slots=True, eq=False)
class GraphEstimate:
    """Result of a solved graph for its submap: refined variables, and how well the newest factors fit.

    - `keyframe_ids` (K,), `T_submap_kf` (K, 4, 4).
    - `landmark_ids` (L,), `xyz_mu` (L, 3).
    - `outlier_rows` (R,) int64: rows of the submap's observation table whose residual is beyond the graph's chi-square
      gate.
    - `chi2_newest`: mean squared whitened residual per degree of freedom of the factors added last (1 is expected).
    - `noise2`: variance that the whitened residuals have (1 where the pixels' sigmas are right): what gates go by.
    - `rebuilt`: true where the solver threw and the graph was made anew from the submap's arrays.
    - `seconds`: CPU time of the calling thread.
    """

    keyframe_ids: IntArray
    T_submap_kf: FloatArray
    landmark_ids: IntArray
    xyz_mu: FloatArray
    outlier_rows: IntArray
    chi2_newest: float
    noise2: float
    rebuilt: bool
    seconds: float

    @property
    def values(self) -> tuple[IntArray, FloatArray, IntArray, FloatArray]:
        """Arguments of `Submap.apply_estimate`."""
        return self.keyframe_ids, self.T_submap_kf, self.landmark_ids, self.xyz_mu


MAX_PRIOR_SIGMAS = 6.0
"""A correction farther from the given calibration than this says that something else is wrong."""
MAX_PATH_CHANGE = 0.02
"""RMS distance between two paths of the same keyframes, over their length. A run whose error is as large is not right
(docs/bench.md). Errors of other causes add to it in squares: a wrong camera may have half of the square."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationEstimate:
    """A camera as estimated from a submap's observations.

    - `correction`: of the calibration that was given.
    - `covariance` (5, 5): of ``correction.vector``, inflated for the correlation of neighbouring observations.
    - `distance2`: squared Mahalanobis distance from the correction that the submap was made with, whose covariance
      counts too where it was estimated.
    - `accepted`: whether it is significantly better than that.
    - `cost_before`, `cost_after`: sum of the Huber losses; before: poses and points as they were.
    - `prior_sigmas`: the largest part of the correction, in standard deviations of its prior.
    - `path_change`: RMS distance by which keyframes would move with the correction, over the length of their path. Zero
      where the correction may be chance.
    """

    correction: LensCorrection
    covariance: FloatArray
    distance2: float
    accepted: bool
    cost_before: float
    cost_after: float
    n_keyframes: int
    n_observations: int
    seconds: float
    prior_sigmas: float = 0.0
    path_change: float = 0.0

    @property
    def numbers(self) -> dict[str, float]:
        """All of it by name, for the event log."""
        names = ("log_focal", "du_px", "dv_px", "k1", "k2")
        sigmas = np.sqrt(np.diag(self.covariance)).tolist()
        return {
            **dict(zip(names, self.correction.vector.tolist(), strict=True)),
            **{f"{name}_sigma": sigma for name, sigma in zip(names, sigmas, strict=True)},
            "distance2": self.distance2,
            "cost_before": self.cost_before,
            "cost_after": self.cost_after,
            "keyframes": self.n_keyframes,
            "observations": self.n_observations,
            "seconds": self.seconds,
            "prior_sigmas": self.prior_sigmas,
            "path_change": self.path_change,
        }


@dataclass(frozen=True, slots=True, eq=False)
class PreferredCamera:
    """The camera that keyframes of a submap would rather have than the one that rectified their features."""

    log_focal: float  # logarithm of both focal lengths that their pixels ask for, less that of the camera's
    log_focal_sigma: float
    distance2: float  # squared Mahalanobis distance of the whole correction from the camera's
    beyond_chance: bool  # whether the pixels contradict the camera
    keyframe_ids: IntArray  # (K,) int64
    T_now: FloatArray  # (K, 4, 4): their poses by the same pixels alone, in a frame and unit of its own
    T_preferred: FloatArray  # (K, 4, 4): the same under the preferred camera
    T_off: FloatArray
    """(N, K, 4, 4): those preferred, with the camera moved by one standard deviation of its own covariance, in each
    independent direction. None if the camera is as it was given."""


@dataclass(frozen=True, slots=True)
class FocalChange:
    """Another focal length from some keyframe on than before it."""

    keyframe_id: int
    log_change: float
    sigma: float

    @property
    def numbers(self) -> dict[str, float]:
        """All but the place by name, for the event log."""
        return {"log_change": self.log_change, "sigma": self.sigma}


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeReport:
    """Effect of a keyframe on the map and its graph.

    - `posed`: with the keyframe's matches alone, before anything was placed from its pose.
    - `grown`: with what was then added; None where the graph takes it in later.
    - `solver_failed`: it threw and had to be made anew.
    """

    posed: GraphEstimate
    grown: GraphEstimate | None
    solver_failed: bool = False

    @property
    def rebuilt(self) -> bool:
        """Whether the graph was made anew, for whatever reason."""
        return self.posed.rebuilt or (self.grown is not None and self.grown.rebuilt)

    @property
    def graph_seconds(self) -> float:
        """Time that the window and the graph took."""
        return self.posed.seconds + (self.grown.seconds if self.grown is not None else 0.0)


@dataclass(frozen=True, slots=True)
class ReadoutEstimate:
    """By how much longer images are read, from the first row to the last, than their features were corrected for."""

    more_s: float  # negative: they are read for less long
    sigma_s: float  # its standard deviation, by the residuals' own noise
    n_keyframes: int
    n_observations: int


@dataclass(frozen=True, slots=True)
class FrontendChoice:
    """The front end that was chosen, and why; `n_features` where it needs another number of them."""

    name: str
    why: str
    n_features: int | None = None
