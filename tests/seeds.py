"""Seeds of a costly test."""

from __future__ import annotations

import pytest


def first_of(seeds: list[int] | range) -> list[object]:
    """Return the first seed for every run, and the others marked as slow."""
    first, *others = seeds
    return [first, *(pytest.param(each, marks=pytest.mark.slow) for each in others)]
