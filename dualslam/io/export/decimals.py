"""Numbers in text for other programs."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

DECIMALS = 15
"""As many as a number of about 1 has: what is left of a 0 after some turns, such as 4.9e-19, is written as 0."""


def decimals(numbers: Iterable[float]) -> str:
    """Return numbers with a space between them, as short as they read back the same, and never with an exponent."""
    return " ".join(np.format_float_positional(round(float(x), DECIMALS) + 0.0, trim="-") for x in numbers)
