"""A map's claimed accuracy, keyframe by keyframe: the columns ``sigma_*`` of ``frames.csv``.

Both are read from the map as it is at the end of a run, whichever way a keyframe came into it: tracked, in reverse too,
or posed again later. A frame claims what the keyframe does that it hangs on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from dualslam.atlas.atlas import Atlas
from dualslam.core.geometry import se3
from dualslam.core.noise_model import GROUP
from dualslam.core.types import FloatArray, IntArray
from dualslam.linking.scale_observability import path_sigmas
from dualslam.map.landmark_views import landmark_covariances, noise_excess, resection_covariance
from dualslam.map.submap import Submap

POSITION_INFLATION = 1.1
"""As `SCALE_INFLATION` (`linking/scale_observability.py`), for positions."""
STRETCH_S = 2.0
"""Seconds of a path whose size is asked for, about a keyframe. It has `GROUP` keyframes at least."""
NEAR = 2
"""Keyframes before and after by whose residuals, too, a position is judged: it is one against what they hold. The first
after a blurred stretch see sharply what the blurred ones have placed."""


@dataclass(frozen=True, slots=True)
class Claim:
    """A map's claims about one keyframe; NaN if unknown."""

    sigma_position_rel: float
    """Standard deviation of the position against what the keyframe sees, over the median depth of that."""
    sigma_scale: float
    """Standard deviation of the logarithm of the size of the path about the keyframe, against that of the whole path:
    by how much it may be too large or too small. Infinite where nothing ties it to the rest."""


def claims_in_atlas(atlas: Atlas) -> dict[int, dict[int, Claim]]:
    """Return the claims of all submaps, with their scales against the largest submap that each is linked to."""
    claims = {m: claims_of(submap) for m, submap in atlas.submaps.items()}
    for component in atlas.components():
        variance = _scale_variances(atlas, component, claims)
        for m in component:
            for k, claim in claims[m].items():
                claims[m][k] = replace(claim, sigma_scale=float(np.sqrt(claim.sigma_scale**2 + variance[m])))
    return claims


def _scale_variances(atlas: Atlas, component: list[int], claims: Mapping[int, Mapping[int, Claim]]) -> dict[int, float]:
    """Return the variance of the log of each submap's scale against the largest's, along the best links.

    A link is measured at one place of either submap. How well the scale is known there adds to its own variance.
    """
    steps = []
    for link in atlas.believed:
        if link.a != link.b and link.a in component:
            at = zip((link.a, link.b), link.attached(atlas), strict=True)
            sigmas = [link.sigma_scale, *(claims[m][k].sigma_scale for m, k in at)]
            steps.append((link.a, link.b, float(np.nansum(np.square(sigmas)))))
    largest = max(component, key=lambda m: len(atlas.submaps[m].keyframes))
    variance = {m: 0.0 if m == largest else np.inf for m in component}
    for _ in component:
        for a, b, more in steps:
            variance[a], variance[b] = min(variance[a], variance[b] + more), min(variance[b], variance[a] + more)
    return variance


def claims_of(submap: Submap) -> dict[int, Claim]:
    """Return what a submap claims of its keyframes, with their scales against its own whole path."""
    excess = noise_excess(submap)
    ids = sorted(submap.keyframes)
    scale, covariances = _scale_sigmas(submap, excess), landmark_covariances(submap, np.arange(len(submap.landmarks)))
    claims = {}
    for n, k in enumerate(ids):
        near = max(excess[other] for other in ids[max(n - NEAR, 0) : n + NEAR + 1])
        claims[k] = Claim(near * _position_sigma(submap, k, covariances), scale[k])
    return claims


def _position_sigma(submap: Submap, keyframe_id: int, covariances: FloatArray) -> float:
    """Resect the keyframe from its landmarks, each as uncertain as its views leave it: `covariances` of all."""
    feature = np.flatnonzero(submap.landmark_of[keyframe_id] >= 0)
    ids = submap.landmark_of[keyframe_id][feature]
    T_cam_submap = se3.inverse(submap.T_submap_kf[keyframe_id])
    sigma = submap.keyframes[keyframe_id].features.sigma_px[feature]
    covariance = resection_covariance(submap, ids, sigma, T_cam_submap, covariances[ids])
    if covariance is None:
        return float("nan")
    depth = submap.depths(ids, T_cam_submap)
    variance = float(np.trace(covariance[3:, 3:]))
    return POSITION_INFLATION * float(np.sqrt(max(variance, 0.0)) / np.median(depth[depth > 0]))


def _scale_sigmas(submap: Submap, excess: dict[int, float]) -> dict[int, float]:
    """Ask for the stretch about each keyframe how well its size is known against that of the whole path."""
    stretches = stretches_of(submap)
    if len(stretches) <= GROUP or not submap.landmarks["alive"].any():
        return dict.fromkeys(stretches, float("nan"))
    sigmas = path_sigmas(submap, list(stretches.values()), excess)
    return dict(zip(stretches, sigmas.tolist(), strict=True))


def stretches_of(submap: Submap) -> dict[int, IntArray]:
    """Return the keyframes of the stretch about each keyframe, by whose size its scale is judged."""
    ids = np.array(sorted(submap.keyframes), np.int64)
    times_s = np.array([submap.keyframes[k].timestamp_s for k in ids.tolist()])
    near = np.abs(np.subtract.outer(times_s, times_s)) <= STRETCH_S / 2.0
    near |= np.abs(np.subtract.outer(np.arange(len(ids)), np.arange(len(ids)))) <= GROUP // 2
    return {k: ids[row] for k, row in zip(ids.tolist(), near, strict=True)}
