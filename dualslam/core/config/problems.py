"""Messages for a wrong configuration: one sentence with the field and the nearest known one."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable, Mapping
from types import UnionType
from typing import TYPE_CHECKING, Any, Self, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError

from dualslam.core.errors import ConfigError, written

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


def sentence(error: ValidationError, root: type[BaseModel]) -> str:
    """Return what is wrong with the first field of the model `root` that is, and how many more are."""
    problems = error.errors(include_url=False)
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    return _of_one(problems[0], tuple(problems[0]["loc"]), root) + more


def nearest_of(word: str, known: Iterable[str]) -> str:
    """Return the question whether the nearest known word was meant, behind a comma; nothing where none is near."""
    near = difflib.get_close_matches(word, list(known), n=1)
    return f", did you mean '{near[0]}'?" if near else ""


def kind(value: Any) -> str:
    """Return what a value is, in a word."""
    kinds = {dict: "mapping", list: "list", str: "text", bool: "bool", int: "number", float: "number"}
    return kinds.get(type(value), "null")


def _of_one(problem: Any, path: tuple[str | int, ...], root: type[BaseModel]) -> str:
    name = written(path)
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
        return f"{name} {message}, not {_shown(problem['input'])}"
    return f"{name}: {message}" if name else message


def _unknown(path: tuple[str | int, ...], root: type[BaseModel]) -> str:
    sections, field = path[:-1], str(path[-1])
    model = _model_at(root, path[:-1])
    known = list(model.model_fields) if model else []
    section = written(sections)
    near = difflib.get_close_matches(field, known, n=1)
    if near:
        hint = f"did you mean {written([*sections, near[0]])}?"
    else:
        elsewhere = [p for p in all_paths(root) if p.rpartition(".")[2] == field]
        hint = f"did you mean {elsewhere[0]}?" if elsewhere else ""
    owner = f"of {section}" if section else "at the top"
    return f"unknown field {written(path)}{'; ' + hint if hint else ''} (fields {owner}: {', '.join(known)})"


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


def all_paths(model: type[BaseModel], prefix: str = "") -> list[str]:
    """Return the names of all fields, those of sections within sections with theirs."""
    paths = []
    for name, field in model.model_fields.items():
        paths.append(prefix + name)
        inner = _model_in(field.annotation)
        if inner:
            paths += all_paths(inner, f"{prefix}{name}.")
    return paths


def _shown(value: Any) -> str:
    try:
        shown = json.dumps(value)
    except (TypeError, ValueError):  # what no file holds: it was given in Python
        return f"a {type(value).__name__}"
    return shown if len(shown) < 60 else f"a {kind(value)}"


class StrictModel(BaseModel):
    """A frozen section of the config that refuses unknown fields.

    Raises `ConfigError`: one sentence: which field, what is wrong with it. (pydantic's own `model_validate` and
    `model_validate_json` raise pydantic's error.)
    """

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    def __init__(self, **data: Any) -> None:
        try:
            super().__init__(**data)
        except ValidationError as error:
            raise ConfigError(f"{type(self).__name__}: {sentence(error, type(self))}") from error

    # pydantic's mark of an __init__ that only validates: sections within sections are then made as strictly as ever.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    if not TYPE_CHECKING:

        def __setattr__(self, name: str, value: object) -> None:
            raise ConfigError(
                f"{type(self).__name__}.{name} cannot be changed, a configuration is frozen: make a new one, with "
                "load_config(overrides=[...]) or with model_copy(update={...})."
            )

    def with_section(self, section: str, /, **values: Any) -> Self:
        """Return a copy in which fields of a section have other values."""
        return self.model_copy(update={section: getattr(self, section).model_copy(update=values)})

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy with other values in some fields, which are checked as all are."""
        copied = super().model_copy(deep=deep)
        if not update:
            return copied
        return type(self)(**{name: getattr(copied, name) for name in type(self).model_fields} | dict(update))
