"""The last word on a submap: all that it has observed, in batch, under a loss that forgets what does not fit.

The graph used by tracking has a part of the observations and Huber's loss, under which an outlier always pulls with the
same force. A loss that forgets leads astray while a map is made; from a map that is right already it leads closer: on
rendered streets by a fifth, on a road by a tenth to two fifths (six seeds, three others). Hand-held maps do not change
(docs/notes/2026-11-27-a-last-batch-over-all-observations.md).
"""

from __future__ import annotations

import numpy as np

from dualslam.backend.local_ba import bundle_adjust
from dualslam.backend.noise import residual_variance
from dualslam.backend.observability import compute_residuals
from dualslam.backend.point_refinement import refit_points
from dualslam.core.bundle import FrameRows
from dualslam.core.types import FloatArray
from dualslam.map.submap import Submap

FORGETS_AT = 4.0
"""Shape of Geman and McClure's loss in standard deviations of the residuals. It uses 95 % of what normal residuals of
two dimensions tell, about as much as Huber's at 1.345 (93 %); at 2 it is 75 %."""
LEAST_NOISE = 0.05
"""Standard deviation that residuals have at least, in the pixels' sigmas: those of made-up pixels vanish."""
ITERATIONS = 3


def refine_submap(submap: Submap, robust_k: float, frames: FrameRows | None = None) -> float:
    """Refine all keyframes and landmarks of a submap, in place.

    Its first keyframe stays where it is, and the mean square distance of the others from it stays what it is.

    - `robust_k`: Huber threshold in sigmas, for landmarks whose depth is too uncertain to take part: they follow the
      poses.
    - `frames`: what frames that are no keyframes have seen: more views of the same landmarks.

    Returns float: shape of the loss, in the pixels' sigmas; `FORGETS_AT` where there is one keyframe.

    Raises `SolverError` if the solver fails. The submap is as it was.
    """
    first, *others = submap.keyframes
    if not others:
        return FORGETS_AT
    shape = FORGETS_AT * _residual_sigma(submap)
    bundle = bundle_adjust(submap, others, [first], shape, ITERATIONS, forgets=True, frames=frames)
    keyframe_ids, T, landmark_ids, xyz_mu = bundle.estimate
    centre, T = submap.T_submap_kf[first][:3, 3], T.copy()
    unit = _extent(submap.keyframe_poses(keyframe_ids), centre) / _extent(T, centre)
    T[:, :3, 3] = centre + unit * (T[:, :3, 3] - centre)
    submap.apply_estimate(keyframe_ids, T, landmark_ids, centre + unit * (xyz_mu - centre))
    beside = np.setdiff1d(np.flatnonzero(submap.landmarks["alive"]), landmark_ids)
    if len(beside):
        submap.landmarks["xyz_mu"][beside] = refit_points(submap, robust_k, beside)
    return shape


def _extent(T_submap_kf: FloatArray, centre: FloatArray) -> float:
    """Return the keyframes' distances from a place, root mean square."""
    return float(np.sqrt(((T_submap_kf[:, :3, 3] - centre) ** 2).sum(axis=1).mean()))


def _residual_sigma(submap: Submap) -> float:
    obs = submap.observations
    rows = np.flatnonzero(obs["alive"])
    ids, pose = np.unique(obs["kf"][rows], return_inverse=True)
    uv, sigma = submap.observed_pixels(rows)
    xyz = submap.landmarks["xyz_mu"][obs["landmark"][rows]]
    chi2 = compute_residuals(submap.K, submap.keyframe_poses(ids), pose, xyz, uv, sigma).chi2
    n_views, finite = np.bincount(obs["landmark"][rows])[obs["landmark"][rows]], np.isfinite(chi2)
    return float(np.sqrt(residual_variance(chi2[finite], n_views[finite], LEAST_NOISE**2)))
