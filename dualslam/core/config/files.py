"""Reading and writing the configuration: strict YAML, overrides, and errors that name the field in one sentence."""

from __future__ import annotations

import json
import logging
import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from dualslam.core.config import strict_yaml
from dualslam.core.config.problems import kind, sentence
from dualslam.core.config.settings import Config
from dualslam.core.errors import ConfigError, written

log = logging.getLogger(__name__)

CONFIG = "config.yaml"
"""In a run folder: the run's configuration."""

Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True, slots=True)
class Override:
    """One field set over whatever the file says."""

    path: tuple[str, ...]  # names from the root of the config to the field
    value: Any
    source: str  # what the user wrote, for error messages

    def sets(self, field: tuple[str | int, ...]) -> bool:
        """Whether it sets a field, a part of it, or what it is a part of."""
        return self.path[: len(field)] == field[: len(self.path)]

    @classmethod
    def parse(cls, text: str) -> Override:
        """Read ``key.path=value``, the value as YAML (``true``, ``null``, ``1e-3``, ``[1, 2]``, a word).

        Raises `ConfigError`: where there is no ``=``, a name is empty or the value is not YAML.
        """
        key, equals, value = text.partition("=")
        path = tuple(part.strip() for part in key.split("."))
        if not equals or not all(path):
            raise ConfigError(f"--set {text}: write key.path=value, for example frontend.n_features=2000")
        try:
            return cls(path, strict_yaml.loads(value), f"--set {text}")
        except ValueError as error:
            raise ConfigError(f"--set {text}: the value is not valid YAML: {error}") from error


def load_config(path: str | Path | None = None, overrides: Iterable[str | Override] = ()) -> Config:
    """Make the configuration from the defaults, a YAML file and overrides, in this order.

    Parameters
    ----------
    path : path, optional
        YAML file; fields it does not name keep their defaults.
    overrides : iterable of str or Override
        ``key.path=value`` texts; the last one for a field wins.

    Raises
    ------
    ConfigError
        One sentence: where, which field, what is wrong, and the nearest known field.
    """
    data: dict[str, Any] = {}
    if isinstance(path, Mapping):
        raise ConfigError("load_config reads a file; of a dict, config_from_dict makes a configuration")
    if isinstance(overrides, str | Mapping):
        raise ConfigError('overrides is a list of texts, such as ["seed=1", "frontend.n_features=2000"]')
    if path is not None:
        data = _read(Path(path))
    return _overridden(data, overrides, str(path) if path is not None else "config")


def load_run_config(folder: str | Path, overrides: Iterable[str | Override] = ()) -> Config:
    """Make the configuration of a run folder, which an earlier version may have written.

    Fields that this version does not have are left out; a warning names them.

    Raises `ConfigError`: as of `load_config`, for all else.
    """
    path = Path(folder) / CONFIG
    data = _read(path)
    gone = _unknown_fields(data)
    for *sections, field in gone:
        owner: Any = data
        for section in sections:
            owner = owner[section]
        del owner[field]
    if gone:
        log.warning("%s: this version of dualslam has no %s; left out", path, ", ".join(map(written, gone)))
    return _overridden(data, overrides, str(path))


def _overridden(data: dict[str, Any], overrides: Iterable[str | Override], source: str) -> Config:
    """Make the configuration of what a file says, with overrides."""
    parsed = [Override.parse(o) if isinstance(o, str) else o for o in overrides]
    for override in parsed:
        _set(data, override)
    return _validate(data, source, parsed, Config)


def _unknown_fields(data: dict[str, Any]) -> list[tuple[int | str, ...]]:
    try:
        Config.model_validate_json(json.dumps(data), strict=True)
    except ValidationError as error:
        return [tuple(e["loc"]) for e in error.errors(include_url=False) if e["type"] == "extra_forbidden"]
    except TypeError:  # `_validate` words it
        pass
    return []


def config_from_dict(data: Mapping[str, Any], source: str = "config") -> Config:
    """Make the configuration from nested plain values, as strictly as `load_config` does.

    Raises `ConfigError`.
    """
    if not isinstance(data, Mapping):
        raise ConfigError(
            f"{source}: a configuration is a mapping of fields to values, this is a {type(data).__name__}"
        )
    return _validate(dict(data), source, [], Config)


def model_from_dict(model: type[Model], data: Mapping[str, Any], source: str) -> Model:
    """Make any strict model from nested plain values, with errors as `load_config` words them.

    Raises `ConfigError`.
    """
    return _validate(dict(data), source, [], model)


def dump_config(config: BaseModel) -> str:
    """Return the whole configuration as YAML, each field under a comment that says what it means.

    Raises `ConfigError` if it is no configuration.
    """
    if not isinstance(config, BaseModel):
        raise ConfigError(f"the configuration is a {type(config).__name__}; load_config or config_from_dict makes one")
    return "\n".join(_dump_fields(config, indent=0)) + "\n"


# --- reading


def _read(path: Path) -> dict[str, Any]:
    data = strict_yaml.read(path, "the configuration")
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: a configuration is a mapping of fields to values, this is a {kind(data)}")
    return data


def _set(data: dict[str, Any], override: Override) -> None:
    *sections, field = override.path
    for depth, section in enumerate(sections):
        inner = data.setdefault(section, {})
        if inner is None:
            inner = data[section] = {}
        if not isinstance(inner, dict):
            name = ".".join(override.path[: depth + 1])
            raise ConfigError(f"{override.source}: {name} is not a section, it has no field {field}")
        data = inner
    data[field] = override.value


def _validate(data: dict[str, Any], source: str, overrides: list[Override], model: type[Model]) -> Model:
    try:
        # By way of JSON: strict about types there (no "5" for 5), yet lists become tuples and words become enums.
        return model.model_validate_json(json.dumps(data), strict=True)
    except ValidationError as error:
        path = tuple(error.errors(include_url=False)[0]["loc"])
        for override in overrides:
            if override.sets(path):
                source = override.source
        raise ConfigError(f"{source}: {sentence(error, model)}") from error
    except TypeError as error:
        raise ConfigError(f"{source}: holds a value that YAML cannot ({error})") from error


# --- writing


def _dump_fields(model: BaseModel, indent: int) -> list[str]:
    pad = "  " * indent
    plain = model.model_dump(mode="json")
    lines: list[str] = []
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        section = isinstance(value, BaseModel)
        meaning = field.description or (value.__doc__ if section else None) or ""
        if indent == 0 and lines:
            lines.append("")
        lines += _comment(meaning, pad)
        if section:
            lines.append(f"{pad}{name}:")
            lines += _dump_fields(value, indent + 1)
        else:
            lines += textwrap.indent(strict_yaml.dumps({name: plain[name]}), pad).splitlines()
    return lines


def _comment(text: str, pad: str) -> list[str]:
    words = " ".join(text.split())
    return textwrap.wrap(words, 120, initial_indent=f"{pad}# ", subsequent_indent=f"{pad}# ")
