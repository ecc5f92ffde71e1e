"""A map's claimed accuracy, keyframe by keyframe: the columns ``sigma_*`` of ``frames.csv``.

Both are read from the map as it is at the end of a run, whichever way a keyframe came into it: tracked, in reverse too,
or posed again later. A frame claims what the keyframe does that it hangs on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualslam.core.geometry import se3
from dualslam.core.noise_model import GROUP
from dualslam.core.types import FloatArray
from dualslam.linking.scale_observability import scale_sigmas_in_all
from dualslam.map.landmark_views import landmark_covariances, noise_excess, resection_covariance
from dualslam.map.submap import Submap

POSITION_INFLATION = 1.1
"""As `SCALE_INFLATION` (`linking/scale_observability.py`), for positions."""
NEAR = 2
"""Keyframes before and after by whose residuals, too, a position is judged: it is one against what they hold. The first
after a blurred stretch see sharply what the blurred ones have placed."""


@dataclass(frozen=True, slots=True)
class Claim:
    """A map's claims about one keyframe; NaN if unknown."""

    sigma_position_rel: float
    """Standard deviation of the position against what the keyframe sees, over the median depth of that."""
    sigma_scale: float
    """Standard deviation of the logarithm of the scale at the keyframe against that of its whole submap: by how much
    what lies there may be too large or too small. Infinite where nothing ties it to the rest."""


def claims_of(submap: Submap) -> dict[int, Claim]:
    """Return what a submap claims of its keyframes."""
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
    """Ask for each group of keyframes how well its scale is known against that of the whole map."""
    ids = np.array(sorted(submap.keyframes), np.int64)
    groups = [ids[begin : begin + GROUP] for begin in range(0, len(ids), GROUP)]
    can_tell = len(groups) > 1 and bool(submap.landmarks["alive"].any())
    places = [(group, ids) for group in groups]
    sigmas = scale_sigmas_in_all(submap, places, excess) if can_tell else [np.nan] * len(groups)
    return {k: sigma for group, sigma in zip(groups, sigmas, strict=True) for k in group.tolist()}
