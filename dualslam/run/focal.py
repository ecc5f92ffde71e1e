"""A source without a calibration: its focal length is searched for before the run."""

from __future__ import annotations

from itertools import islice
from typing import Any

from dualslam.build import find_focal
from dualslam.config.settings import Config
from dualslam.core.camera.focal import FocalSearch
from dualslam.core.errors import InputError
from dualslam.core.interfaces import Sequence
from dualslam.core.types import Failure
from dualslam.run.sources import open_source

SEARCHED_FRAMES = 200
"""From the beginning: some seconds, in which a camera in a hand or on a car has moved."""
ANY_FOV_DEG = 60.0
"""To read the images by; the search asks nothing of it."""


def open_without_calibration(config: Config, source: str, **selection: Any) -> tuple[Sequence, FocalSearch]:
    """Open a source that has no calibration with the focal length that its first frames tell.

    Parameters
    ----------
    config : Config
    source : str
        Not a webcam: what it shows is gone once it has been looked at.
    **selection
        Which frames, as in `open_source`.

    Raises
    ------
    InputError
        If the source cannot be read, or its beginning does not tell.
    """
    first = open_source(source, fov_degrees=ANY_FOV_DEG, **selection | {"reverse": False})
    size_px = first.camera.width, first.camera.height
    found = find_focal(config, islice(first, SEARCHED_FRAMES), size_px)
    if isinstance(found, Failure):
        raise InputError(
            f"{first.name} has no calibration, and its first {SEARCHED_FRAMES} frames do not tell the focal length "
            f"({found.detail}); give a camera file, or a field of view in degrees."
        )
    return open_source(source, fov_degrees=found.fov_deg, **selection), found
