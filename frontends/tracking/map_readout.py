"""The question to a map for the readout time of its rolling shutter (answered in `backend/readout.py`).

In a bundle of the keyframes that turn fast it is one more unknown, beside their poses and points: the camera sees each
line in another orientation, and the frames around it give the rate of turn. A map, whose points are known from other
views, shows it to about a millisecond; pairs of frames only separate 20 ms from none.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dualslam.core.arrays import rank_in_runs
from dualslam.core.bundle import BundleProblem, ReadoutProblem
from dualslam.core.noise_model import MIN_DEPTH_MU, PROOF_VIEWS
from dualslam.core.types import Failure, FailureReason, FloatArray, IntArray
from dualslam.frontends.tracking.turning import read_at
from dualslam.map.submap import Submap

MAX_KEYFRAMES = 40
"""Neighbours in time; of all such windows the one with most turning."""
MIN_KEYFRAMES = 8
PER_KEYFRAME = 150
"""Observations of each, of the landmarks with the longest tracks: they tell, and bound the time (0.1 s)."""
MIN_OBSERVATIONS = 500


def ask_readout(
    submap: Submap, rates_rad_s: Mapping[int, FloatArray], size_px: tuple[int, int]
) -> ReadoutProblem | Failure:
    """Ask a submap for how much longer its images were read than its features were corrected for.

    - `submap`: is not changed.
    - `rates_rad_s` (mapping of int to (3,)): how the camera turns at each keyframe, in its own axes; those that are
      missing tell nothing.
    - `size_px`: width and height of the image.
    """
    ids = np.array(sorted(k for k in submap.keyframes if k in rates_rad_s), np.int64)
    if len(ids) < MIN_KEYFRAMES:
        return Failure(FailureReason.DEGENERATE, f"{len(ids)} keyframes")
    rates = np.array([rates_rad_s[k] for k in ids.tolist()])
    chosen = _most_turning(rates)
    question = _collect(submap, ids[chosen], rates[chosen], size_px)
    if (n := len(question.by_readout)) < MIN_OBSERVATIONS:
        return Failure(FailureReason.TOO_FEW_INLIERS, f"{n} observations")
    return question


def _most_turning(rates_rad_s: FloatArray) -> slice:
    """Return which `MAX_KEYFRAMES` neighbours turn most."""
    n = len(rates_rad_s)
    if n <= MAX_KEYFRAMES:
        return slice(0, n)
    turn2 = np.concatenate([[0.0], np.cumsum((rates_rad_s**2).sum(1))])
    within = turn2[MAX_KEYFRAMES:] - turn2[:-MAX_KEYFRAMES]
    first = int(np.argmax(within))
    return slice(first, first + MAX_KEYFRAMES)


def _collect(submap: Submap, ids: IntArray, rates_rad_s: FloatArray, size_px: tuple[int, int]) -> ReadoutProblem:
    obs, K = submap.observations, submap.K
    rows = np.flatnonzero(obs["alive"] & np.isin(obs["kf"], ids))
    kf, landmark = np.searchsorted(ids, obs["kf"][rows]), obs["landmark"][rows]
    T = submap.keyframe_poses(ids)
    depth = np.einsum("rj,rj->r", T[kf, :3, 2], submap.landmarks["xyz_mu"][landmark] - T[kf, :3, 3])
    rows, kf, landmark = rows[depth > MIN_DEPTH_MU], kf[depth > MIN_DEPTH_MU], landmark[depth > MIN_DEPTH_MU]
    # The longest tracks of each keyframe; then what has views enough among all of them.
    n_views = np.bincount(landmark, minlength=len(submap.landmarks))
    order = np.lexsort((landmark, -n_views[landmark], kf))
    rank = np.empty(len(kf), np.int64)
    rank[order] = rank_in_runs(kf[order])
    wanted = np.zeros(len(submap.landmarks), np.bool_)
    wanted[landmark[rank < PER_KEYFRAME]] = True
    kept = wanted[landmark] & (n_views[landmark] >= PROOF_VIEWS)
    rows, kf, landmark = rows[kept], kf[kept], landmark[kept]
    points, point = np.unique(landmark, return_inverse=True)
    uv, sigma = submap.observed_pixels(rows)
    f, c = np.diag(K)[:2], K[:2, 2]
    rays = np.column_stack([(uv - c) / f, np.ones(len(uv))])
    read_px = np.empty((len(rows), 2))
    for n, k in enumerate(ids.tolist()):
        here = kf == n
        read_px[here] = submap.keyframes[k].features.uv_px[obs["feature"][rows[here]]]
    turned = -np.cross(rates_rad_s[kf] * read_at(read_px, size_px)[:, None], rays)
    by_readout = f * (turned[:, :2] - rays[:, :2] * turned[:, 2:])
    first = np.arange(len(ids)) == 0
    bundle = BundleProblem(K, T, first, submap.landmarks["xyz_mu"][points], kf, point, uv, sigma)
    return ReadoutProblem(bundle, by_readout)
