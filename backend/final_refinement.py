"""The last word on a submap: all that it has observed, in batch, under a loss that forgets what does not fit.

The graph used by tracking has a part of the observations and Huber's loss, under which an outlier always pulls with the
same force. A loss that forgets leads astray while a map is made; from a map that is right already it leads closer
(docs/notes/2026-11-27-a-last-batch-over-all-observations.md).

The landmarks with most views go first. A false match with few views, right before the camera, bends a pose until it
agrees (docs/notes/2026-11-28-few-false-near-points-hold-a-wrong-pose.md).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from dualslam.backend.local_ba import bundle_adjust
from dualslam.backend.noise import residual_variance
from dualslam.backend.observability import compute_residuals
from dualslam.backend.point_refinement import refit_points
from dualslam.core.bundle import FrameRows
from dualslam.core.geometry import se3
from dualslam.core.types import FloatArray, IntArray
from dualslam.map.submap import Submap

FORGETS_AT = 4.0
"""Shape of Geman and McClure's loss in standard deviations of the residuals. It uses 95 % of what normal residuals of
two dimensions tell, about as much as Huber's at 1.345 (93 %); at 2 it is 75 %."""
LEAST_NOISE = 0.05
"""Standard deviation that residuals have at least, in the pixels' sigmas: those of made-up pixels vanish."""
ITERATIONS = 3
WIDER = (16.0, 4.0)
"""Times as wide as the loss is where landmarks were made one: their places differ by tens of pixels."""


def refine_submap(submap: Submap, robust_k: float, frames: FrameRows | None = None) -> float:
    """Refine all keyframes and landmarks of a submap, in place.

    Its first keyframe stays where it is, and the mean square distance of the others from it stays what it is.

    - `robust_k`: Huber threshold in sigmas, for landmarks whose depth is too uncertain to take part: they follow the
      poses.
    - `frames`: what frames that are no keyframes have seen: more views of the same landmarks.

    Returns float: shape of the loss, in the pixels' sigmas; `FORGETS_AT` where there is one keyframe.

    Raises `SolverError` if the solver fails. The submap is as it was.
    """
    if len(submap.keyframes) < 2:
        return FORGETS_AT
    shape = FORGETS_AT * _residual_sigma(submap)
    _refine(submap, robust_k, ((shape, _best_seen(submap)), (shape, None)), frames)
    return shape


def settle_ties(submap: Submap, robust_k: float) -> None:
    """Bend a submap in which landmarks were made one that it had in different places, in place, for `refine_submap`.

    Keyframes and the best seen landmarks suffice: the rest follows. Parameters and errors are as there.
    """
    shape, best = FORGETS_AT * _residual_sigma(submap), _best_seen(submap)
    _refine(submap, robust_k, ((wider * shape, best) for wider in WIDER), None)


def _refine(
    submap: Submap, robust_k: float, passes: Iterable[tuple[float, IntArray | None]], frames: FrameRows | None
) -> None:
    """Refine a submap in passes, each with a shape of the loss and the landmarks that take part; the others follow.

    Without landmarks, None, all take part.
    """
    first, *others = submap.keyframes
    refined, seen = submap.copy(), submap.landmarks_of_keyframes([first, *others])
    centre = se3.translation(submap.T_submap_kf[first])
    for width, landmarks in passes:
        bundle = bundle_adjust(refined, others, [first], width, ITERATIONS, True, frames, landmarks)
        refined.apply_estimate(*bundle.estimate)
        if frames is not None:
            frames = replace(frames, T_submap_cam=bundle.T_submap_frame)
        beside = np.setdiff1d(seen, bundle.estimate[2])
        refined.landmarks["xyz_mu"][beside] = refit_points(refined, robust_k, beside)
    T = refined.keyframe_poses(others)
    unit = _extent(submap.keyframe_poses(others), centre) / _extent(T, centre)
    T[:, :3, 3] = centre + unit * (se3.translation(T) - centre)
    submap.apply_estimate(np.array(others), T, seen, centre + unit * (refined.landmarks["xyz_mu"][seen] - centre))


def _best_seen(submap: Submap) -> IntArray:
    """Return the landmarks with as many views as their keyframe's median, in half of the keyframes that see them."""
    n_views = submap.n_observations(np.arange(len(submap.landmarks)))
    n_leads = np.zeros(len(n_views), np.int64)
    for seen in submap.landmark_of.values():
        ids = seen[seen >= 0]
        if len(ids):
            n_leads[ids[n_views[ids] >= np.median(n_views[ids])]] += 1
    return np.flatnonzero(submap.landmarks["alive"] & (n_leads > 0) & (2 * n_leads >= n_views))


def _extent(T_submap_kf: FloatArray, centre: FloatArray) -> float:
    """Return the keyframes' distances from a place, root mean square."""
    return float(np.sqrt(((se3.translation(T_submap_kf) - centre) ** 2).sum(axis=1).mean()))


def _residual_sigma(submap: Submap) -> float:
    obs = submap.observations
    rows = np.flatnonzero(obs["alive"])
    ids, pose = np.unique(obs["kf"][rows], return_inverse=True)
    uv, sigma = submap.observed_pixels(rows)
    xyz = submap.landmarks["xyz_mu"][obs["landmark"][rows]]
    chi2 = compute_residuals(submap.K, submap.keyframe_poses(ids), pose, xyz, uv, sigma).chi2
    n_views, finite = np.bincount(obs["landmark"][rows])[obs["landmark"][rows]], np.isfinite(chi2)
    return float(np.sqrt(residual_variance(chi2[finite], n_views[finite], LEAST_NOISE**2)))
