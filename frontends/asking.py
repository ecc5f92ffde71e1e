"""Asking a front end for features: what another package's returns is looked at before it goes into a map."""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import NDArray

from dualslam.core.errors import FrontendError
from dualslam.core.interfaces import Frontend
from dualslam.core.types import Features

_KINDS = {"uv_px": "f", "uv_rect_px": "f", "sigma_px": "f", "scale": "f", "octave": "iu", "angle_rad": "f"}
"""Of the arrays' types, as numpy has them; `dualslam.frontends.conformance` asks for more."""


def features_of(frontend: Frontend, image: NDArray[np.uint8]) -> Features:
    """Return the features of an image.

    Raises `FrontendError`: as `checked` says.
    """
    return checked(frontend, frontend.extract(image))


def checked(frontend: Frontend, found: object) -> Features:
    """Return what a front end has found, if it is what it should be.

    Raises `FrontendError` if it is not `Features`, or its arrays are of different lengths or of other types.
    """
    ours = type(frontend).__module__.startswith("dualslam.")
    if not ours and (problem := _problem(found)):
        raise FrontendError(
            f"front end '{type(frontend).__module__}:{type(frontend).__qualname__}': extract returned {problem}; "
            "dualslam.frontends.conformance.check_frontend says all that is wrong with it."
        )
    return cast(Features, found)


def _problem(found: object) -> str | None:
    if not isinstance(found, Features):
        return f"a {type(found).__name__}, not dualslam.core.types.Features"
    for name in (*_KINDS, "descriptors"):
        array = getattr(found, name)
        if not isinstance(array, np.ndarray):
            return f"Features whose {name} is a {type(array).__name__}, not a numpy array"
        if array.dtype.kind not in _KINDS.get(name, "biuf"):
            return f"Features whose {name} is of type {array.dtype}"
        per_feature = {"uv_px": (2,), "uv_rect_px": (2,), "descriptors": array.shape[1:2]}.get(name, ())
        if array.shape != (*found.uv_px.shape[:1], *per_feature):
            return f"Features whose {name} is {array.shape}, beside {found.uv_px.shape} of uv_px"
    return None
