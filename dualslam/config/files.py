"""Reading and writing the configuration: strict YAML, overrides, and errors that name the field in one sentence."""

from __future__ import annotations

import difflib
import json
import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from dualslam.config import strict_yaml
from dualslam.config.former import RENAMED, what_became_of
from dualslam.config.settings import Config
from dualslam.core.errors import ConfigError

Model = TypeVar("Model", bound=BaseModel)

_PLAIN_WORDS = {
    "must be an object": "must be a mapping of fields",
    "a valid integer": "a whole number",
    "a valid string": "a word",
    "a valid number": "a number",
    "a valid boolean": "true or false",
    "a valid array": "a list",
    "a valid list": "a list",
    "tuple should have": "must have",
    " after validation": "",
}


@dataclass(frozen=True, slots=True)
class Override:
    """One field set over whatever the file says.

    Attributes
    ----------
    path : tuple of str
        Names from the root of the config to the field.
    value : Any
    source : str
        What the user wrote, for error messages.
    """

    path: tuple[str, ...]
    value: Any
    source: str

    @classmethod
    def parse(cls, text: str) -> Override:
        """Read ``key.path=value``, the value as YAML (``true``, ``null``, ``1e-3``, ``[1, 2]``, a word).

        Raises
        ------
        ConfigError
            Where there is no ``=``, a name is empty or the value is not YAML.
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
    if path is not None:
        data = _read(Path(path))
    parsed = [Override.parse(o) if isinstance(o, str) else o for o in overrides]
    for override in parsed:
        _set(data, override)
    return _validate(data, str(path) if path is not None else "config", parsed, Config)


def config_from_dict(data: Mapping[str, Any], source: str = "config") -> Config:
    """Make the configuration from nested plain values, as strictly as `load_config` does."""
    return _validate(dict(data), source, [], Config)


def model_from_dict(model: type[Model], data: Mapping[str, Any], source: str) -> Model:
    """Make any strict model from nested plain values, with errors as `load_config` words them.

    Raises
    ------
    ConfigError
    """
    return _validate(dict(data), source, [], model)


def dump_config(config: BaseModel) -> str:
    """Return the whole configuration as YAML, each field under a comment that says what it means."""
    return "\n".join(_dump_fields(config, indent=0)) + "\n"


# --- reading


def _read(path: Path) -> dict[str, Any]:
    data = strict_yaml.read(path, "the configuration")
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: a configuration is a mapping of fields to values, this is a {_kind(data)}")
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
        problems = error.errors(include_url=False)
        path = tuple(problems[0]["loc"])
        for override in overrides:
            if override.path[: len(path)] == path or path[: len(override.path)] == override.path:
                source = override.source
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise ConfigError(f"{source}: {_sentence(problems[0], path, model)}{more}") from error
    except TypeError as error:
        raise ConfigError(f"{source}: holds a value that YAML cannot ({error})") from error


def _sentence(problem: Any, path: tuple[str | int, ...], root: type[BaseModel]) -> str:
    name = ".".join(map(str, path))
    if problem["type"] == "extra_forbidden":
        return _unknown(path, root)
    if problem["type"] == "missing":
        return f"{name} is missing"
    message = str(problem["msg"]).removeprefix("Value error, ").replace("Input should be", "must be")
    message = message[:1].lower() + message[1:]
    for jargon, plain in _PLAIN_WORDS.items():
        message = message.replace(jargon, plain)
    if message.startswith("must have"):
        return f"{name} {message}"
    if message.startswith("must be"):
        shown = json.dumps(problem["input"])
        return f"{name} {message}, not {shown if len(shown) < 60 else 'a ' + _kind(problem['input'])}"
    return f"{name}: {message}" if name else message


def _unknown(path: tuple[str | int, ...], root: type[BaseModel]) -> str:
    *sections, field = map(str, path)
    model = _model_at(root, path[:-1])
    known = list(model.model_fields) if model else []
    if RENAMED.get(field) in known:
        return f"{'.'.join(map(str, path))} is now called {'.'.join([*sections, RENAMED[field]])}"
    former = what_became_of(".".join(map(str, path)))
    if former:
        return former
    section = ".".join(sections)
    near = difflib.get_close_matches(field, known, n=1)
    if near:
        hint = f"did you mean {'.'.join([*sections, near[0]])}?"
    else:
        elsewhere = [p for p in _all_paths(root) if p.rpartition(".")[2] == field]
        hint = f"did you mean {elsewhere[0]}?" if elsewhere else ""
    owner = f"of {section}" if section else "at the top"
    return f"unknown field {'.'.join(map(str, path))}{'; ' + hint if hint else ''} (fields {owner}: {', '.join(known)})"


def _model_at(model: type[BaseModel], path: tuple[str | int, ...]) -> type[BaseModel] | None:
    current: type[BaseModel] | None = model
    for name in path:
        if isinstance(name, int):
            continue
        if current is None or name not in current.model_fields:
            return None
        current = _model_in(current.model_fields[name].annotation)
    return current


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """Return the model that a field holds, alone, optional or in a list; None for a plain field."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if get_origin(annotation) in (Union, UnionType, list, tuple):
        return next((m for m in map(_model_in, get_args(annotation)) if m), None)
    return None


def _all_paths(model: type[BaseModel], prefix: str = "") -> list[str]:
    paths = []
    for name, field in model.model_fields.items():
        paths.append(prefix + name)
        inner = _model_in(field.annotation)
        if inner:
            paths += _all_paths(inner, f"{prefix}{name}.")
    return paths


def _kind(value: Any) -> str:
    kinds = {dict: "mapping", list: "list", str: "text", bool: "bool", int: "number", float: "number"}
    return kinds.get(type(value), "null")


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
