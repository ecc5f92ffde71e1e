"""Bundle adjustment of what registration has added to a submap; what does not fit, or has no depth, is removed."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from dualslam.backend.local_ba import bundle_adjust
from dualslam.core.chi_square import CHI2_99
from dualslam.core.noise_model import TINY
from dualslam.core.types import FloatArray, IntArray
from dualslam.map.submap import Submap

ITERATIONS = 5


def adjust_and_prune(
    submap: Submap,
    keyframe_ids: Collection[int],
    robust_k: float,
    min_parallax_rad: float,
    noise2: float = 1.0,
) -> None:
    """Adjust some keyframes and the landmarks that they see, in place; then remove what does not fit.

    - `keyframe_ids`: where they are all of the submap's, its first two stay.
    - `min_parallax_rad`: landmarks that are seen under a smaller angle are removed. A pose that stands on them has no
      scale, and neither have the landmarks that are triangulated from there.
    - `noise2`: variance of the whitened residuals.

    Raises `SolverError` if the solver fails.
    """
    free, held = list(keyframe_ids), None
    if len(free) == len(submap.keyframes):
        held = [k for k in submap.gauge if k in submap.keyframes] or free[:1]
        free = [k for k in free if k not in held]
    bundle = bundle_adjust(submap, free, held, robust_k, ITERATIONS)
    submap.apply_estimate(*bundle.estimate)
    submap.remove_outliers(bundle.rows[~(bundle.result.chi2 < noise2 * CHI2_99[2])])
    seen = submap.landmarks_of_keyframes(list(keyframe_ids))
    submap.remove_landmarks(seen[parallax_rad(submap, seen) < min_parallax_rad])


def parallax_rad(submap: Submap, landmark_ids: IntArray) -> FloatArray:
    """Return about the widest angle (N,) between the rays by which each landmark is seen.

    From the ray farthest from the first one to the ray farthest from that: exact where a camera moves along a line.

    `landmark_ids` (N,): ascending.
    """
    rows = submap.rows_of_landmarks(landmark_ids)
    ids, pose = np.unique(submap.observations["kf"][rows], return_inverse=True)
    landmark = submap.observations["landmark"][rows]
    rays = submap.landmarks["xyz_mu"][landmark] - submap.keyframe_poses(ids)[pose, :3, 3]
    rays /= np.maximum(np.linalg.norm(rays, axis=1), TINY)[:, None]
    order = np.argsort(landmark, kind="stable")
    rays, point = rays[order], np.searchsorted(landmark_ids, landmark[order])
    begins = np.flatnonzero(np.diff(point, prepend=-1))
    reference, widest = rays[begins], np.ones(len(landmark_ids))
    at = np.cumsum(np.diff(point, prepend=-1) > 0) - 1
    for _ in range(2):
        cosine = np.einsum("ij,ij->i", rays, reference[at])
        farthest = np.lexsort((cosine, point))[begins]
        reference = rays[farthest]
        widest[point[begins]] = cosine[farthest]
    return np.arccos(np.clip(widest, -1.0, 1.0))
