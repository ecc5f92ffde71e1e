"""`frontend.name: auto`: the front end that a sequence's first frames ask for, named before the run."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dualslam.build import find_frontend
from dualslam.core.config.files import CONFIG, load_run_config
from dualslam.core.config.settings import Config
from dualslam.core.estimates import FrontendChoice
from dualslam.core.interfaces import Sequence
from dualslam.io import sequence

AUTO, ORB = "auto", "orb"


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
