"""Bounds and noise models by which links, and places, are believed."""

from __future__ import annotations

from dualslam.core.chi_square import CHI2_99
from dualslam.core.noise_model import GROUP

PAIR_CHI2 = CHI2_99[3]
"""Gate of a matched pair's squared Mahalanobis distance: chi-square, 3 degrees of freedom, 99 %."""
PIXEL_CHI2 = CHI2_99[2]
"""Gate of a squared whitened reprojection residual: chi-square, 2 degrees of freedom, 99 %."""
MIN_PAIRS_PER_KEYFRAME = 8
"""Matched landmarks that a keyframe must hold to have a say (four fix a similarity with one to spare)."""
MAX_MISFITS = 1
"""Keyframes in a row that may disagree before this counts as a change point: one can be wrong by itself."""
MIN_TIES = 10
"""Landmarks that keyframes on both sides of a place in the old map must see in agreement with their pixels. With fewer
the old map is broken there, and its newer part counts as suspected."""
LOOK_BACK = 2 * GROUP
"""Keyframes of the old map, older than the oldest shared one, among which a break is still looked for."""
MINORITY_DEFORMATION = 0.03
"""Relative deformation (standard deviation) of a map beyond a place where it hands on fewer than half of what its
keyframes see. Where an occluder comes in, maps of rendered worlds lost up to 8 % of their scale and claimed 0.9 %."""
MIN_IMAGE_SPREAD = 0.25
"""Share of the image, along either axis, that the agreeing landmarks must cover (5 % to 95 % of them, against the
keypoints of the same keyframes)."""
MAX_SCALE = 50.0
"""Largest scale, and inverse of the smallest: submaps start with a median depth of 1, so that the scale is the ratio
of the depths at their starts."""
MAX_HYPOTHESES = 512
"""Triplets that RANSAC draws at most."""
