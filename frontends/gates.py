"""Quantiles and counts that decide what is believed, the same in every step of a front end."""

from __future__ import annotations

CHI2_1DOF_95 = 3.841
"""Squared whitened distance to a line that 95 % of true matches do not exceed."""
CHI2_2DOF_95 = 5.991
"""The same for the distance to a point."""
CHI2_2DOF_99 = 9.210
"""And for 99 % of them."""
CHI2_6DOF_99 = 16.812
"""Squared Mahalanobis distance of a pose below which 99 % lie."""
MIN_CONSENSUS = 12
"""Matches below which a RANSAC consensus of a 3-point solver is no evidence."""
