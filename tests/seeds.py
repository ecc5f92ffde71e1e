"""Seeds, or other cases, of a costly test."""

from __future__ import annotations

from collections.abc import Sequence

import pytest


def first_of(cases: Sequence[object]) -> list[object]:
    """Return the first case for every run, and the others marked as slow."""
    first, *others = cases
    return [first, *(pytest.param(each, marks=pytest.mark.slow) for each in others)]
