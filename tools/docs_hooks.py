"""Build hooks of the documentation: equations as MathML, configuration, notebooks, and search from the disk.

mkdocs calls the functions named ``on_...`` for each page. Equations are written as on GitHub: ``$...$`` within a
line, ``$$...$$`` on lines of their own.
"""

from __future__ import annotations

import html
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files
from pydantic import BaseModel

from dualslam.core.config.settings import Config

FIELDS = "<!-- every field of the configuration -->"
# Code comes first: what looks like an equation in it is none.
_PIECES = re.compile(r"(```.*?```|`[^`\n]*`)|\$\$(.+?)\$\$|(?<![\w$\\])\$([^\s$](?:[^$\n]*[^\s$])?)\$(?!\w)", re.DOTALL)
_TOKEN = "equation{}of{}"


def on_files(files: Files, config: Any, **_: Any) -> Files:
    """Add the notebooks, with what they print and draw, as pages."""
    for path in sorted((Path(config.config_file_path).parent / "notebooks").glob("*.ipynb")):
        content = notebook_page(json.loads(path.read_text(encoding="utf-8")), path.name)
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=content))
    return files


def notebook_page(notebook: dict[str, Any], name: str) -> str:
    """Return a notebook as Markdown."""
    parts = []
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        parts.append(f"```python\n{source}\n```" if cell["cell_type"] == "code" else source)
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if "image/png" in data:
                picture = "".join(data["image/png"]).replace("\n", "")
                parts.append(f"![what this cell draws](data:image/png;base64,{picture})")
            else:
                text = "".join(output.get("text") or data.get("text/plain", ""))
                parts.append(f"```text\n{text.rstrip()}\n```")
    parts.insert(1, f"*This page is `notebooks/{name}`, with what it printed and drew.*")
    return "\n\n".join(parts) + "\n"


def on_post_build(config: Any, **_: Any) -> None:
    """Write the search index as a script, too: pages from the disk may not fetch it (`search_from_disk.js`)."""
    folder = Path(config.site_dir) / "search"
    index = (folder / "search_index.json").read_text(encoding="utf-8")
    (folder / "search_index.js").write_text(f"const searchIndex = {index};\n", encoding="utf-8")


def on_post_page(output: str, **_: Any) -> str:
    """Add the two style sheets that the theme's dark mode switches: it fails without, and its own would be fetched."""
    return output.replace("</head>", '<style id="hljs-light"></style><style id="hljs-dark"></style></head>', 1)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Put the configuration in, and tokens instead of equations, which Markdown must not touch."""
    page.meta["equations"] = equations = []

    def replace(found: re.Match[str]) -> str:
        code, block, inline = found.groups()
        if code is not None:
            return str(code)
        equations.append(math(block, "block") if block is not None else math(inline, "inline"))
        token = _TOKEN.format(len(equations) - 1, "page")
        return f"\n\n{token}\n\n" if block is not None else token

    return _PIECES.sub(replace, markdown.replace(FIELDS, configuration_page()))


def on_page_content(content: str, page: Any, **_: Any) -> str:
    """Put the equations back."""
    for i, equation in enumerate(page.meta["equations"]):
        content = content.replace(_TOKEN.format(i, "page"), equation, 1)
    return content


def math(latex: str, display: str) -> str:
    """Return an equation as MathML, which browsers draw without help."""
    return str(convert(" ".join(latex.split()), display=display))


def configuration_page() -> str:
    """Return a section for each part of the configuration, with all its fields."""
    return "\n## At the top\n\n" + _fields(Config, "") + "\n" + "\n".join(_sections(Config, "", "##"))


def _sections(model: type[BaseModel], above: str, heading: str) -> Iterator[str]:
    for name, field in model.model_fields.items():
        inner = _model_in(field.annotation)
        if inner is not None:
            path = f"{above}{name}"
            meaning = _sentence(field.description or inner.__doc__ or "")
            yield f"\n{heading} {path}\n\n{meaning}\n\n{_fields(inner, path)}"
            yield from _sections(inner, f"{path}.", heading + "#")


def _fields(model: type[BaseModel], section: str) -> str:
    """Return the plain fields of a model as an HTML list: descriptions hold what Markdown would take for markup."""
    items = []
    for name, field in model.model_fields.items():
        if _model_in(field.annotation) is not None:
            continue
        path = f"{section}.{name}" if section else name
        default = "required" if field.is_required() else _value(field.get_default(call_default_factory=True))
        limits = ", ".join(_limit(m) for m in field.metadata if _limit(m))
        values = html.escape(f"{_type(field.annotation)}{', ' if limits else ''}{limits}")
        term = f"<code>{path}</code> <b>{html.escape(default)}</b> <small>{values}</small>"
        items.append(f"<dt>{term}</dt><dd>{_sentence(field.description or '')}</dd>")
    return f'<dl class="fields">{"".join(items)}</dl>\n'


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((m for m in map(_model_in, get_args(annotation)) if m is not None), None)


def _value(value: Any) -> str:
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(_value, value)) + "]"
    plain = {True: "true", False: "false", None: "null"}
    return plain[value] if isinstance(value, bool | None) else str(value)


def _type(annotation: Any) -> str:
    words = {"int": "whole number", "float": "number", "str": "word", "bool": "true or false", "dict": "mapping"}
    name = getattr(annotation, "__name__", str(annotation))
    if get_args(annotation):
        inner = [_type(a) for a in get_args(annotation) if a not in (type(None), ...)]
        outer = getattr(getattr(annotation, "__origin__", None), "__name__", "")
        if outer == "dict":
            return "mapping"
        if outer in ("list", "tuple"):
            return f"list of {inner[0]}" if inner else "list"
        if outer == "Literal":
            return " or ".join(map(str, get_args(annotation)))
        return " or ".join([*inner, *(["null"] if type(None) in get_args(annotation) else [])])
    if isinstance(annotation, type) and issubclass(annotation, str) and annotation is not str:
        return " or ".join(str(member) for member in annotation)  # type: ignore[attr-defined]
    return words.get(name, name)


def _limit(constraint: Any) -> str:
    signs = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
    return next((f"{sign} {getattr(constraint, key)}" for key, sign in signs.items() if hasattr(constraint, key)), "")


def _sentence(text: str) -> str:
    escaped = html.escape(" ".join(text.split()), quote=False)
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escaped)
