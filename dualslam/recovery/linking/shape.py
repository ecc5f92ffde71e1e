"""How the shapes of two maps differ beyond a similarity: strain, parts that want another scale or turn, the path."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dualslam.config.settings import LinkingConfig
from dualslam.core.geometry import se3, sim3
from dualslam.core.types import BoolArray, Failure, FailureReason, FloatArray
from dualslam.recovery.linking.gates import GATE_SIGMAS
from dualslam.recovery.linking.pairs import PairModel

UNTESTABLE = 3.0
"""A part whose own sigma is this many times the allowed deformation says nothing about it."""
ALONG_AXIS = 4.0
"""How much worse a camera's centre is known along its axis than across it: focal length over the landmarks' offset."""
ROTATION_SHARE = 0.25
"""How much less orientation drifts (rad) than scale does (relative)."""


@dataclass(frozen=True, slots=True)
class Deviation:
    """By how much a part of the maps wants another similarity than the whole, and how well that is known."""

    part: str
    log_scale: float
    sigma_log_scale: float
    turn_rad: float = 0.0
    sigma_turn_rad: float = math.inf

    def scale_deviates(self, config: LinkingConfig) -> bool:
        """Whether the part's scale is off by more than noise and healthy drift explain."""
        return _beyond(self.log_scale, self.sigma_log_scale, config)

    def turn_deviates(self, config: LinkingConfig) -> bool:
        """Whether the part's rotation is."""
        return _beyond(self.turn_rad, self.sigma_turn_rad, config)


def _beyond(value: float, sigma: float, config: LinkingConfig) -> bool:
    """Whether a deviation is significant under its noise and the allowed deformation."""
    allowed = config.deformation_sigma
    return sigma < UNTESTABLE * allowed and abs(value) > GATE_SIGMAS * math.hypot(sigma, allowed)


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """What was measured.

    Attributes
    ----------
    strain : (5,)
        Coordinates in `pairs.STRAINS` of the strain that takes the new map's shape to the old one's.
    strain_covariance : (5, 5)
    parts : list of Deviation
        Halves of the pairs, and the cameras' path.
    """

    strain: FloatArray
    strain_covariance: FloatArray
    parts: list[Deviation]

    def strain_chi2(self, config: LinkingConfig) -> float:
        """Return the strain's squared Mahalanobis distance under its noise and the allowed deformation."""
        covariance = self.strain_covariance + config.deformation_sigma**2 * np.eye(5)
        return float(self.strain @ np.linalg.solve(covariance, self.strain))

    def deformation(self, config: LinkingConfig) -> float:
        """Return by how much drift changes the scale along time, less noise; at least half of what is expected.

        Where drift is a random walk, the mean over the overlap is off by about half of what its ends differ.
        """
        along_time = [d for d in self.parts if d.part in ("early", "late", "path")]
        known = [d for d in along_time if d.sigma_log_scale < UNTESTABLE * config.deformation_sigma]
        excess2 = max((d.log_scale**2 - d.sigma_log_scale**2 for d in known), default=0.0)
        return math.sqrt(max(excess2, 0.25 * config.deformation_sigma**2))


def measure_shape(model: PairModel, S_old_new: FloatArray, inliers: BoolArray, keyframes: BoolArray) -> Shape | Failure:
    """Measure how the maps differ in shape where a similarity holds.

    The strain is estimated together with a change of the similarity, in one Gauss-Newton step from it. Each half of the
    pairs (left and right, top and bottom, near and far, early and late) takes a step of its own.

    Parameters
    ----------
    model : PairModel
    S_old_new : (4, 4)
    inliers : (M,) bool
        Pairs that agree with it.
    keyframes : (K,) bool
        Keyframes that do.

    Returns
    -------
    Shape or Failure
        `DEGENERATE` where the pairs do not fix an affine map (all in one plane, seen without noise).
    """
    H, g = model.normal_equations(S_old_new, inliers)
    try:
        covariance = np.asarray(np.linalg.inv(H), np.float64)
    except np.linalg.LinAlgError:
        return Failure(FailureReason.DEGENERATE, "the landmarks do not fix their own shape")
    parts = [_deviation(model, S_old_new, name, part) for name, part in _halves(model, inliers, keyframes).items()]
    parts.append(_deviation_of_path(model, S_old_new, keyframes))
    return Shape((covariance @ g)[7:], covariance[7:, 7:], parts)


def deformation_covariance(model: PairModel, deformation: float) -> FloatArray:
    """Return (7, 7) that a deformation adds to a link's covariance (right perturbation, frame new).

    The pairs all bend together, so that more of them do not help. In scale and in position relative to the landmarks'
    distance, that is; orientation drifts less.
    """
    distance = np.linalg.norm(model.pairs.xyz_new[:, None] - model.T_new_kf[None, :, :3, 3], axis=2)
    sigma = np.repeat([ROTATION_SHARE, float(np.median(distance)), 1.0], [3, 3, 1]) * deformation
    from_centre = sim3.adjoint(se3.from_parts(np.eye(3), model.centre_new))
    return np.asarray(from_centre @ np.diag(sigma**2) @ from_centre.T, np.float64)


def _halves(model: PairModel, inliers: BoolArray, keyframes: BoolArray) -> dict[str, BoolArray]:
    """Split the inlier pairs at the median of image position, depth and time."""
    c = model.pairs
    n = len(c)
    views = inliers[c.view_pair] & keyframes[c.view_keyframe]
    count = np.maximum(np.bincount(c.view_pair[views], minlength=n), 1)

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(c.view_pair[views], values[views], n) / count, np.float64)

    halves = {}
    for low, high, value in (
        ("left", "right", mean(c.uv_old[:, 0])),
        ("upper", "lower", mean(c.uv_old[:, 1])),
        ("near", "far", mean(model.depths_old())),
        ("early", "late", mean(c.view_keyframe.astype(np.float64))),
    ):
        below = value <= np.median(value[inliers])
        halves[low], halves[high] = inliers & below, inliers & ~below
    return halves


def _deviation(model: PairModel, S_old_new: FloatArray, name: str, part: BoolArray) -> Deviation:
    """Let a part of the pairs take a Gauss-Newton step of its own; sigmas are infinite where it does not fix one."""
    H, g = model.normal_equations(S_old_new, part)
    try:
        step, C = np.linalg.solve(H[:7, :7], g[:7]), np.linalg.inv(H[:7, :7])
    except np.linalg.LinAlgError:
        return Deviation(name, 0.0, math.inf)
    if not (np.diag(C) > 0).all():
        return Deviation(name, 0.0, math.inf)
    turn = float(np.linalg.norm(step[:3]))
    axis = step[:3] / max(turn, 1e-12)
    return Deviation(
        name, float(step[6]), math.sqrt(C[6, 6]), turn, math.sqrt(max(float(axis @ C[:3, :3] @ axis), 0.0))
    )


def _deviation_of_path(model: PairModel, S_old_new: FloatArray, keyframes: BoolArray) -> Deviation:
    """Compare the scale of the cameras' path with that of the landmarks: in a sound map these two agree.

    A centre is known to about one pixel's worth at the landmarks' distance, over the root of their number, and several
    times worse along the optical axis. It matters where landmarks are seen in the healthy part but were placed by what
    the corrupted one saw of them: they then agree with each other in a wrong scale, and only the path is right.
    """
    centres = model.T_old_kf[keyframes, :3, 3]
    moved = sim3.act(S_old_new, model.T_new_kf[keyframes, :3, 3])
    n = np.bincount(model.pairs.view_keyframe, minlength=len(keyframes))[keyframes]
    distance = float(np.median(np.linalg.norm(model.pairs.xyz_old - centres.mean(0), axis=1)))
    noise = ALONG_AXIS * distance / (float(model.K_old[0, 0]) * math.sqrt(float(np.median(n))))
    centres, moved = centres - centres.mean(0), moved - moved.mean(0)
    length2 = float((moved**2).sum())
    if not length2 > noise**2:
        return Deviation("path", 0.0, math.inf)
    return Deviation("path", float((centres * moved).sum()) / length2 - 1.0, noise / math.sqrt(length2))
