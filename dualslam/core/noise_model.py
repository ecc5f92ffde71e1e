"""Bounds that rooms share: how errors are distributed, and how much evidence a conclusion needs."""

from __future__ import annotations

GATE_SIGMAS = 3.0
"""Standard deviations at which a comparison fails: chance alone exceeds them once in 370 times."""
INFLATION = 4.0
"""How much larger than the residuals say the errors of pixels are taken to be, because neighbouring ones err alike.
With the exact camera (rendered images) corrections came out up to 3.8 times as far from zero as the Hessian says."""
MAJORITY = 0.5
"""Share that must agree. Below a half those that disagree could hold another answer with more support."""
PROOF_VIEWS = 3
"""Views that prove a point: two show it on the epipolar line of each other, where anything may be."""
MIN_CONSENSUS = 12
"""Matches below which a RANSAC consensus of a 3-point solver is no evidence."""
START_POINTS = 50
"""Points of two views that a map starts from, at least, as they are left after the first bundle adjustment."""
PAIR_MATCHES = round(1.2 * START_POINTS)
"""Matches of two views below which no relative pose is estimated: a sixth of them may be wrong."""
MIN_DEPTH_MU = 1e-3
"""Nearer points count as behind the camera, shorter baselines as none. A submap's median depth is 1 at first."""
MAX_DEPTH_SIGMA = 0.25
"""A point's distance counts as known to this relative standard deviation. It is about half a degree of parallax at 1 px
and a focal length of 700 px."""
MISSING_INTERVALS = 2.5
"""Times the usual interval between frames: those further apart have others missing between them."""
BASELINE_SIGMA = 1e-4
"""Sigma of a map's first baseline, relative to its length: it holds the scale."""
CELLS_ACROSS = 16
"""Cells of an image's width by which observations are spread."""
MAX_SLIP = 0.1
"""Share of the way that a map can have lost beyond what its turn and change of scale explain. 32 right loops (HoloLens,
TUM, 7-Scenes, a phone) lost 3 % at most. The copy of a thing lies a period away, and is neither turned nor scaled."""
SAME_WITHIN = 0.1
"""Distance, relative to the size or depth of what is seen, within which two answers are one."""
GROUP = 5
"""Keyframes that see much the same: about as long as a landmark lives on a road. Fewer say little about a place's
scale, and what lies more than twice as far off shares little with them."""
SAME_POINT_PX = 3.0
"""Distance at the finest octave within which two keypoints can be the same point: three sigmas of a pixel."""
MIN_LANDMARKS = 6
"""Landmarks that hold a pose: three fix it, twice as many tell how well."""
COVISIBLE = 15
"""Landmarks in common from which two keyframes count as covisible."""
ROBUST_N = 5
"""Numbers whose median survives two outliers."""
GROWN = 1.5
"""Times its keyframes, from which a map is worth a question again: a sigma is then a fifth smaller at best."""
ROBUST_K = 0.8
"""Huber threshold in sigmas: about twice what residuals are."""
DAMPING = 1e-4
"""Of normal equations, relative to the diagonal: keeps where it is what nothing fixes."""
MAX_TRIES = 3
"""Times that what fails by chance is tried in vain before it counts as broken."""
STRETCH_S = 2.0
"""Seconds of a path by whose size and shape it is judged."""
UNSURE_SCALE = 0.1
"""Standard deviation of the logarithm of the size of two seconds of the path: with more it is off by 20 % with a
probability above 5 %. What is off by so much is too large or too small to be measured in."""
TINY = 1e-12
"""A divisor in place of zero."""
LEAST = 1e-300
"""A divisor in place of zero, where even the smallest numbers count."""
