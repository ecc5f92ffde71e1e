"""Quantiles and counts that decide what is believed, the same in every step of a front end."""

from __future__ import annotations

MIN_CONSENSUS = 12
"""Matches below which a RANSAC consensus of a 3-point solver is no evidence."""
