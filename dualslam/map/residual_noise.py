"""How noisy a submap's keyframes are: what a soft image adds to residuals, it adds to what does not average out."""

from __future__ import annotations

import numpy as np

from dualslam.core.chi_square import variance_by_median
from dualslam.core.geometry import se3
from dualslam.core.geometry.projection import project_points
from dualslam.map.submap import Submap

USUAL_NOISE = 0.33
"""Standard deviation of residuals, in the pixels' sigmas, for which the inflations of claims are made: that of plain
stretches. In blurred ones it is 0.4 to 0.7."""
MIN_VIEWS, MIN_RESIDUALS = 3, 10
"""What a keyframe's residuals are read from: landmarks of so many views, and so many of them. With less it is usual."""


def noise_excess(submap: Submap) -> dict[int, float]:
    """Return how many times larger than is usual each keyframe's residuals are, by their median; at least 1."""
    obs = submap.observations
    n_views = np.bincount(obs["landmark"][obs["alive"]], minlength=len(submap.landmarks))
    excess = dict.fromkeys(submap.keyframes, 1.0)
    for k, keyframe in submap.keyframes.items():
        feature = np.flatnonzero(submap.landmark_of[k] >= 0)
        ids = submap.landmark_of[k][feature]
        feature, ids = feature[n_views[ids] >= MIN_VIEWS], ids[n_views[ids] >= MIN_VIEWS]
        uv, _ = project_points(submap.K, se3.inverse(submap.T_submap_kf[k]), submap.landmarks["xyz_mu"][ids])
        features = keyframe.features
        chi2 = ((uv - features.uv_rect_px[feature]) ** 2).sum(axis=1) / features.sigma_px[feature] ** 2
        finite = np.isfinite(chi2)
        if np.count_nonzero(finite) >= MIN_RESIDUALS:
            variance = variance_by_median(chi2[finite], n_views[ids[finite]])
            excess[k] = max(1.0, float(np.sqrt(variance)) / USUAL_NOISE)
    return excess
