"""Checks of a config before anything is built."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from traceback import walk_tb

from dualslam.atlas.stored_map import StoredMap
from dualslam.core.camera.base import Camera
from dualslam.core.config.settings import AttemptConfig, Config, FrontendConfig
from dualslam.core.errors import ConfigError, FrontendError, InputError
from dualslam.frontends.features.motion_statistics import nearest_search
from dualslam.frontends.registry import check_frontend, create_pixel_matcher, package_of


def check_config(config: Config) -> None:
    """Refuse a config that no system can be built from, as far as it shows without extras and weights.

    Raises `ConfigError` if it is no configuration. If a front end (also of an attempt at a recovery) or the pixel
    matcher is not known, or its options are wrong. If the initialiser cannot match with it.
    """
    if not isinstance(config, Config):
        raise ConfigError(f"the configuration is a {type(config).__name__}; load_config or config_from_dict makes one")
    frontend = check_frontend(config.frontend)
    if frontend is not None and config.initialiser.matching == "gms":
        nearest_search(frontend)
    create_pixel_matcher(config.pixels)
    for number, attempt in enumerate(config.recovery.attempts):
        if not attempt.is_live:
            with naming_attempt(number):
                check_frontend(auxiliary_config(attempt))


def check_given(camera: Camera, saved: StoredMap | None) -> None:
    """Refuse what is no camera and no saved map, such as a path to one.

    Raises `InputError`.
    """
    if not isinstance(camera, Camera):
        raise InputError(f"the camera is a {type(camera).__name__}; a sequence has one, as sequence.camera.")
    if saved is not None and not isinstance(saved, StoredMap):
        raise InputError(f"the saved map is a {type(saved).__name__}; load_atlas reads one.")


def fault_of_frontend(error: BaseException, config: Config) -> FrontendError | None:
    """Return what to say of an exception of another package's front end or pixel matcher; None where none raised it."""
    frontends = [config.frontend.name, *(a.frontend for a in config.recovery.attempts if not a.is_live)]
    named = [("front end", name) for name in frontends]
    named += [] if config.pixels.name is None else [("pixel matcher", config.pixels.name)]
    for noun, name in named:
        package = package_of(name)
        for frame, line in reversed(list(walk_tb(error.__traceback__))):
            module = str(frame.f_globals.get("__name__", ""))
            if package is not None and module.partition(".")[0] == package:
                where = f"{frame.f_code.co_filename}, line {line}, in {frame.f_code.co_name}"
                return FrontendError(f"{noun} '{name}' raised {type(error).__name__}: {error} ({where}).")
    return None


def auxiliary_config(attempt: AttemptConfig) -> FrontendConfig:
    """Return the front end that an attempt names."""
    return FrontendConfig(name=attempt.frontend, n_features=attempt.n_features, options=attempt.options)


@contextmanager
def naming_attempt(number: int) -> Iterator[None]:
    """Say of a mistake in the config that it is in this attempt."""
    try:
        yield
    except ConfigError as error:
        place = error.field[1:]  # in the section `frontend`
        inside = ("frontend",) if place == ("name",) else place
        raise ConfigError(error.problem, ("recovery", "attempts", number, *inside)) from error
