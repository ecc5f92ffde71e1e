"""Camera files as mappings: YAML with OpenCV's dialect, JSON, XML, and what ROS's calibrator writes as text."""

from __future__ import annotations

import json
import re
from collections import Counter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import yaml

from dualslam.core.errors import InputError

Mapping = dict[str, Any]


class _FileStorageLoader(yaml.SafeLoader):
    """YAML as OpenCV writes it, with its own tag for matrices. A key that stands there twice is a slip."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value]
        for position, key in enumerate(keys):
            if key in keys[:position]:
                problem = f"the key {key!r} stands there twice"
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.value[position][0].start_mark)
        return super().construct_mapping(node, deep)


def _opencv_matrix(loader: yaml.SafeLoader, node: yaml.MappingNode) -> Any:
    return loader.construct_mapping(node, deep=True)


for _tag in ("opencv-matrix", "opencv-nd-matrix"):
    _FileStorageLoader.add_constructor(f"tag:yaml.org,2002:{_tag}", _opencv_matrix)


def read_mappings(path: Path, text: str) -> list[Mapping]:
    """Return the mappings of a file: one for each of its documents, as ROS writes them behind ``---``.

    Raises `InputError`: it is none of these formats, or holds none.
    """
    if text.lstrip().startswith("<"):
        documents = [_of_xml(path, text)]
    elif path.suffix.lower() == ".json":
        documents = [_of_json(path, text)]
    elif re.search(r"^\[image\]\s*$", text, re.MULTILINE):
        documents = [_of_calibrator(text)]
    else:
        documents = _of_yaml(path, text)
    found = [document for document in documents if document is not None]
    if not found or not all(isinstance(document, dict) for document in found):
        raise InputError(f"{path} is not a camera file: it should hold fields such as fx, fy, cx, cy, width, height.")
    return found


def parse_yaml(path: Path, text: str) -> Mapping:
    """Parse a file of one YAML document, OpenCV's dialect included."""
    return read_mappings(path, text)[0]


def _of_yaml(path: Path, text: str) -> list[Any]:
    # OpenCV's `%YAML:1.0` is not a directive that YAML knows.
    lines = ["" if line.startswith("%YAML") else line for line in text.splitlines()]
    try:
        return list(yaml.load_all("\n".join(lines), _FileStorageLoader))  # a SafeLoader
    except (yaml.YAMLError, RecursionError) as e:
        where, problem = getattr(e, "problem_mark", None), getattr(e, "problem", None)
        line = f", line {where.line + 1}" if where else ""
        raise InputError(f"{path}{line} is not valid YAML{f': {problem}' if problem else ''}; correct it.") from e


def _of_json(path: Path, text: str) -> Any:
    def each_once(pairs: list[tuple[str, Any]]) -> Mapping:
        for key, n in Counter(key for key, _ in pairs).items():
            if n > 1:
                raise InputError(f"{path}: the key {key!r} stands there twice; correct it.")
        return dict(pairs)

    try:
        return json.loads(text, object_pairs_hook=each_once)
    except json.JSONDecodeError as e:
        raise InputError(f"{path}, line {e.lineno} is not valid JSON; correct it.") from e


def _of_xml(path: Path, text: str) -> Any:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(f"{path} declares XML entities, which no camera file needs; remove them.")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as e:
        raise InputError(f"{path}, line {e.position[0]} is not valid XML; correct it.") from e
    return _of_element(root)


def _of_element(element: ElementTree.Element) -> Any:
    """Return an element's content: attributes and children by name, those of one name as a list, or its words."""
    found: Mapping = dict(element.attrib)
    for child in element:
        value = _of_element(child)
        if child.tag in found:
            before = found[child.tag]
            found[child.tag] = [*before, value] if isinstance(before, list) else [before, value]
        else:
            found[child.tag] = value
    words = (element.text or "").replace('"', " ").split()
    if not found:
        return words[0] if len(words) == 1 else words
    return found


def _of_calibrator(text: str) -> Mapping:
    """Read the ``ost.txt`` of ROS's camera_calibration: a name on a line, numbers on those below it."""
    found: dict[str, list[str]] = {}
    name = ""
    for line in text.splitlines():
        words = line.split("#", 1)[0].split()
        if words and not line.startswith("["):
            if re.match(r"[A-Za-z]", words[0]) and words[0].lower() not in ("nan", "inf"):
                name = " ".join(words)
            else:
                found.setdefault(name, []).extend(words)
    return {name: words[0] if len(words) == 1 else words for name, words in found.items()}
