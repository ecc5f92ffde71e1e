"""YAML without surprises: the core schema of YAML 1.2, where ``1e-3`` is a number, ``no`` a word, keys are unique."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from dualslam.core.errors import ConfigError

_SCALARS: list[tuple[str, str, str]] = [
    ("null", r"null|Null|NULL|~|", "~nN"),
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("int", r"[-+]?[0-9]+|0x[0-9a-fA-F]+", "-+0123456789"),
    ("float", r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", "-+0123456789."),
    ("float", r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)", "-+."),
]


def _resolvers() -> dict[str | None, list[tuple[str, re.Pattern[str]]]]:
    table: dict[str | None, list[tuple[str, re.Pattern[str]]]] = {}
    for name, pattern, first_characters in _SCALARS:
        entry = (f"tag:yaml.org,2002:{name}", re.compile(rf"(?:{pattern})\Z"))
        for character in [*first_characters, *([""] if name == "null" else [])]:
            table.setdefault(character, []).append(entry)
    return table


class _Loader(yaml.SafeLoader):
    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.MarkedYAMLError(problem="aliases (*name) are not taken", problem_mark=mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for position, key in enumerate(keys):
            if not isinstance(key, str):
                raise _error(f"the key {key!r} is not a word", node.value[position][0])
            if key in keys[:position]:
                raise _error(f"the key {key!r} stands there twice", node.value[position][0])
        return super().construct_mapping(node, deep)

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        text = node.value
        return int(text, 16) if text.startswith("0x") else int(text)

    def construct_yaml_float(self, node: yaml.ScalarNode) -> float:
        return float(node.value.lower().replace(".inf", "inf").replace(".nan", "nan"))


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)
_Loader.add_constructor("tag:yaml.org,2002:float", _Loader.construct_yaml_float)


class _Dumper(yaml.SafeDumper):
    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        super().increase_indent(flow, False)


_Loader.yaml_implicit_resolvers = _resolvers()
_Dumper.yaml_implicit_resolvers = _resolvers()


def _error(problem: str, node: yaml.Node) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)


def read(path: Path, what: str, source: str = "") -> Any:
    """Read a file of YAML.

    - `what`: what the file is, for the error: ``the configuration``.
    - `source`: what to call the file there; its path if empty.

    Raises `ConfigError`: it cannot be read, or is no YAML of this kind.
    """
    source = source or str(path)
    try:
        return loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{source}: {what} cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{source}: {what} is not a text file in UTF-8") from error
    except ValueError as error:
        raise ConfigError(f"{source}: {error}") from error


def loads(text: str) -> Any:
    """Read one YAML document.

    Raises `ValueError`: in one sentence, with line and column where they are known.
    """
    try:
        return yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        problem = error.problem or "not valid YAML"
        if problem == "but found another document":
            problem = "a second document begins here, and only one is read; remove what divides them (---)"
        raise ValueError(f"{where}{problem}") from error
    except yaml.YAMLError as error:
        raise ValueError(f"not valid YAML ({' '.join(str(error).split())})") from error


def dumps(value: Any) -> str:
    """Write a value so that `loads` gives it back exactly."""
    return yaml.dump(value, Dumper=_Dumper, sort_keys=False, width=110)
