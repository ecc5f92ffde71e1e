"""Counts of the sources that the budget limits: literals, constants, settings, long sentences, private words."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterable, Iterator
from pathlib import Path

MAX_WORDS = 25
"""Words of a sentence, above which it counts as long."""
MIN_SPACES = 5
"""Spaces in a string or a table cell, from which on it is prose. A key or a file name has fewer."""
FREE = (0, 1, 2)
"""Numbers that do not count: indices, halves and squares."""

_CODE = re.compile(r"`[^`]*`")
_LINK = re.compile(r"\[([^\]]*)\]\([^)]*\)")
_FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
_END = re.compile(r"(?<=[.!?:])\s+|\n\s*\n|\n\s*[-*]\s")
_WORD = re.compile(r"[A-Za-z][A-Za-z'-]*")


def count_literals(tree: ast.AST) -> int:
    """Count the numbers written in a module, but for 0, 1 and 2."""
    return sum(_is_counted(node) for node in ast.walk(tree))


def count_constants(tree: ast.AST) -> int:
    """Count upper-case names of a module or a class whose value holds a number other than 0, 1 and 2."""
    n = 0
    for scope in ast.walk(tree):
        if not isinstance(scope, ast.Module | ast.ClassDef):
            continue
        for node in scope.body:
            if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None and count_literals(node.value):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                names = [inner.id for target in targets for inner in ast.walk(target) if isinstance(inner, ast.Name)]
                n += sum(name.lstrip("_").isupper() for name in names)
    return n


def count_settings(trees: Iterable[ast.AST], root: str = "Config") -> int:
    """Count the fields of the class `root` and of its sections; a list of models is one field."""
    classes = {node.name: node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}

    def fields_of(name: str) -> int:
        annotations = [node.annotation for node in classes[name].body if isinstance(node, ast.AnnAssign)]
        sections = [a.id for a in annotations if isinstance(a, ast.Name) and a.id in classes]
        return len(annotations) - len(sections) + sum(map(fields_of, sections))

    return fields_of(root) if root in classes else 0


def prose_of(path: Path) -> Iterator[str]:
    """Yield the prose of a Python or Markdown file: docstrings, comments and messages, or paragraphs and cells."""
    text = path.read_text(encoding="utf-8")
    yield from _prose_of_python(text) if path.suffix == ".py" else _prose_of_markdown(text)


def count_long_sentences(prose: Iterable[str]) -> int:
    """Count the sentences of more than `MAX_WORDS` words; code in backticks is one word, a link its text."""
    parts = (part for text in prose for part in _END.split(_plain(text)))
    return sum(len(_WORD.findall(part)) > MAX_WORDS for part in parts)


def count_words(prose: Iterable[str], words: Iterable[str]) -> int:
    """Count the places where one of the words stands, in any case and in code; the longest one where several begin."""
    choices = sorted(words, key=len, reverse=True)
    if not choices:
        return 0
    pattern = re.compile(rf"\b(?:{'|'.join(map(re.escape, choices))})\b", re.IGNORECASE)
    return sum(len(pattern.findall(text)) for text in prose)


def _is_counted(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and type(node.value) in (int, float, complex) and node.value not in FREE


def _plain(text: str) -> str:
    return _LINK.sub(r"\1", _CODE.sub("x", text))


def _prose_of_python(text: str) -> Iterator[str]:
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.count(" ") >= MIN_SPACES:
            yield node.value
    comment: list[str] = []
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            comment.append(token.string.lstrip("# "))
        elif token.type not in (tokenize.NL, tokenize.NEWLINE) and comment:
            yield " ".join(comment)
            comment = []


def _prose_of_markdown(text: str) -> Iterator[str]:
    paragraph: list[str] = []
    for line in [*_FENCE.sub("", text).splitlines(), ""]:
        if line.startswith("|"):
            yield from (cell for cell in line.split("|") if cell.count(" ") >= MIN_SPACES)
        elif line.strip() and not line.lstrip().startswith("#"):
            paragraph.append(line)
        elif paragraph:
            yield "\n".join(paragraph)
            paragraph = []
