"""By how much two maps are bent against each other beyond a similarity: their change of scale along time."""

from __future__ import annotations

import math

import numpy as np

from dualslam.core.config.settings import LinkingConfig
from dualslam.core.geometry import se3, sim3, so3
from dualslam.core.types import BoolArray, FloatArray
from dualslam.linking.pairs import PairModel

UNTESTABLE = 3.0
"""Times the expected deformation: a part whose own sigma is larger says nothing about it."""
ALONG_AXIS = 4.0
"""How much worse a camera's centre is known along its axis than across it: focal length over the landmarks' offset."""
ROTATION_SHARE = 0.25
"""How much less orientation drifts (rad) than scale does (relative)."""


def measure_deformation(
    model: PairModel, S_old_new: FloatArray, inliers: BoolArray, keyframes: BoolArray, config: LinkingConfig
) -> float:
    """Return by how much drift changes the scale along time, less noise; at least half of what is expected.

    The older and the newer half of the pairs, and the cameras' path, are each compared with the whole. By a random walk
    the mean over the overlap is off by about half of what its ends differ.

    - `S_old_new` (4, 4).
    - `inliers` (M,), `keyframes` (K,) bool: pairs and keyframes that agree with it.
    """
    c = model.pairs
    views = inliers[c.view_pair] & keyframes[c.view_keyframe]
    count = np.maximum(np.bincount(c.view_pair[views], minlength=len(c)), 1)
    time = np.bincount(c.view_pair[views], c.view_keyframe[views].astype(np.float64), len(c)) / count
    early = time <= np.median(time[inliers])
    changes = [_change_of_scale(model, S_old_new, inliers & half) for half in (early, ~early)]
    changes.append(_change_of_path(model, S_old_new, keyframes))
    expected = config.deformation_sigma
    excess2 = [change**2 - sigma**2 for change, sigma in changes if sigma < UNTESTABLE * expected]
    return math.sqrt(max([0.25 * expected**2, *excess2]))


def deformation_covariance(model: PairModel, deformation: float) -> FloatArray:
    """Return (7, 7) that a deformation, which bends all pairs together, adds to a link's covariance (right
    perturbation, new).
    """
    distance = np.linalg.norm(model.pairs.xyz_new[:, None] - se3.translation(model.T_new_kf)[None], axis=2)
    sigma = np.repeat([ROTATION_SHARE, float(np.median(distance)), 1.0], [3, 3, 1]) * deformation
    from_centre = sim3.adjoint(se3.from_parts(so3.IDENTITY, model.centre_new))
    return np.asarray(from_centre @ np.diag(sigma**2) @ from_centre.T, np.float64)


def _change_of_scale(model: PairModel, S_old_new: FloatArray, part: BoolArray) -> tuple[float, float]:
    """Return the change of scale, and its sigma, by which a part of the pairs fits best: one Gauss-Newton step."""
    H, g = model.normal_equations(S_old_new, part)
    try:
        step, C = np.linalg.solve(H, g), np.linalg.inv(H)
    except np.linalg.LinAlgError:
        return 0.0, math.inf
    return (float(step[6]), math.sqrt(C[6, 6])) if (np.diag(C) > 0).all() else (0.0, math.inf)


def _change_of_path(model: PairModel, S_old_new: FloatArray, keyframes: BoolArray) -> tuple[float, float]:
    """Compare the scale of the cameras' path with that of the landmarks: in a sound map these two agree.

    A centre is known to about one pixel at the landmarks' distance, over the root of their number. Along the optical
    axis it is several times worse. Landmarks that were placed by what a corrupted part saw agree with each other in a
    wrong scale: only the path is right.
    """
    centres = model.T_old_kf[keyframes, :3, 3]
    moved = sim3.act(S_old_new, model.T_new_kf[keyframes, :3, 3])
    n = np.bincount(model.pairs.view_keyframe, minlength=len(keyframes))[keyframes]
    distance = float(np.median(np.linalg.norm(model.pairs.xyz_old - centres.mean(0), axis=1)))
    noise = ALONG_AXIS * distance / (float(model.K_old[0, 0]) * math.sqrt(float(np.median(n))))
    centres, moved = centres - centres.mean(0), moved - moved.mean(0)
    length2 = float((moved**2).sum())
    if not length2 > noise**2:
        return 0.0, math.inf
    return float((centres * moved).sum()) / length2 - 1.0, noise / math.sqrt(length2)
