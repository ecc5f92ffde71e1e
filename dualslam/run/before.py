"""What a source's first frames, or a saved map, decide before a run: the camera and the front end."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

from dualslam.build import find_focal, find_frontend
from dualslam.core.camera.focal import FocalSearch
from dualslam.core.camera.mapped import own_camera
from dualslam.core.config.files import CONFIG, load_run_config
from dualslam.core.config.settings import Config
from dualslam.core.errors import InputError
from dualslam.core.estimates import FrontendChoice
from dualslam.core.interfaces import Sequence
from dualslam.core.types import Failure
from dualslam.io import sequence
from dualslam.io.map_store import load_camera
from dualslam.io.sequence import RecordedSequence, camera_of_size
from dualslam.run.sources import ANY_FOV_DEG, open_source

SEARCHED_FRAMES = 200
"""The first ones: some seconds, in which a camera in a hand or on a car has moved."""
AUTO, ORB = "auto", "orb"


def open_without_calibration(source: str, **selection: Any) -> RecordedSequence:
    """Open a source that has no calibration, by a camera that only has the size of its images.

    - `source`: not a webcam: what it shows is gone once it has been looked at.
    - `**selection`: which frames, as in `open_source`.

    Raises `InputError` if the source cannot be read.
    """
    sequence = open_source(source, fov_degrees=ANY_FOV_DEG, **selection)
    assert isinstance(sequence, RecordedSequence)  # a world has a camera of its own
    return sequence


def with_camera_found(config: Config, sequence: RecordedSequence) -> tuple[RecordedSequence, FocalSearch]:
    """Return a sequence with the camera that its first frames tell, and the source's own data, and what they tell.

    Raises `InputError` if they do not tell.
    """
    found = find_focal(config, islice(sequence, SEARCHED_FRAMES), sequence.camera.size_px, sequence.told_focal())
    if isinstance(found, Failure):
        n_frames = min(len(sequence), SEARCHED_FRAMES)
        raise InputError(
            f"{sequence.name} has no calibration, and its first {n_frames} frames do not tell the "
            f"focal length ({found.detail}); give a camera file, or a field of view "
            "in degrees (--camera, --fov)."
        )
    return sequence.with_camera(found.camera()), found


def with_camera_of_map(saved_map: str | Path, sequence: RecordedSequence) -> RecordedSequence | None:
    """Return a sequence with the camera, as it was given, that a saved map was made by.

    Images of another size and the same shape are taken for the same camera's. None where the map has no camera, or one
    of images of another shape: then it was another.

    Raises `InputError` if the map cannot be read.
    """
    camera = load_camera(saved_map)
    if camera is None:
        return None
    try:
        of_map = camera_of_size(own_camera(camera), sequence.camera.size_px, sequence.name, f"the map of {saved_map}")
    except InputError:
        return None
    return sequence.with_camera(of_map)


def with_prior(config: Config, found: FocalSearch) -> Config:
    """Return a config whose self-calibration trusts the focal length as far as it was found."""
    sigma = max(config.calibration.log_focal_sigma, found.log_sigma)
    return config.with_section("calibration", log_focal_sigma=sigma)


def with_frontend_chosen(
    config: Config, frames: Sequence | None, saved_map: str | Path | None = None
) -> tuple[Config, FrontendChoice | None]:
    """Return a config that names its front end, and why; None where it names one already.

    A saved map is continued by the front end that made it. ORB it is where frames cannot be looked at beforehand, and
    where the config has settings that are ORB's.

    - `frames`: none where frames come only once, or must keep to a clock.
    - `saved_map`: the run folder that is continued.
    """
    if config.frontend.name != AUTO:
        return config, None
    if saved_map is not None and (Path(saved_map) / CONFIG).is_file():
        frontend = load_run_config(saved_map).frontend
        choice = FrontendChoice(frontend.name, "it made the saved map")
        return config.model_copy(update={"frontend": frontend}), choice
    if config.frontend.options or config.initialiser.matching == "gms":
        choice = FrontendChoice(ORB, "the configuration has settings for it")
    elif frames is None:
        choice = FrontendChoice(ORB, "frames are not looked at before the run")
    else:
        with _faults_unreported():
            choice = find_frontend(config, frames, frames.camera)
    chosen = {"name": choice.name, "n_features": choice.n_features or config.frontend.n_features}
    return config.with_section("frontend", **chosen), choice


@contextmanager
def _faults_unreported() -> Iterator[None]:
    """Leave damaged images to the run, which reads them again and reports them then."""
    log = logging.getLogger(sequence.__name__)
    log.disabled = True
    try:
        yield
    finally:
        log.disabled = False
