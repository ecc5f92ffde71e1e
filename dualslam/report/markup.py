"""HTML and SVG as nested calls: what is not `Markup` is text, and is escaped."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files

# The browser itself refuses scripts and whatever is outside of the page.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
_VOID = frozenset({"meta", "link", "img", "br"})


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


def tag(name: str, /, *children: object, **attributes: object) -> Markup:
    """Return one element.

    - `*children`: text is escaped, None is left out.
    - `**attributes`: ``cls`` is class, a trailing underscore is dropped, other underscores become hyphens; None is left
      out.
    """
    text = "".join(
        f' {_attribute_name(key)}="{html.escape(_plain(value))}"'
        for key, value in attributes.items()
        if value is not None
    )
    if name in _VOID:
        return Markup(f"<{name}{text}>")
    return Markup(f"<{name}{text}>{join(children)}</{name}>")


def join(children: object) -> Markup:
    """Return children one after the other, escaped where they are plain text."""
    if children is None:
        return Markup("")
    if isinstance(children, Markup):
        return children
    if isinstance(children, str | int | float):
        return Markup(html.escape(_plain(children)))
    if isinstance(children, Iterable):
        return Markup("".join(join(child) for child in children))
    raise TypeError(f"{type(children).__name__} is no child of an element")


def table(heads: Sequence[str], rows: Sequence[Markup], cls: str, caption: str | None = None) -> Markup:
    """Return a table of ready rows; `heads` stand above its columns, none: there is no such line."""
    head = tag("thead", tag("tr", [tag("th", words, scope="col") for words in heads])) if heads else None
    return tag("table", None if caption is None else tag("caption", caption), head, tag("tbody", rows), cls=cls)


def number_row(head: str, numbers: Sequence[str]) -> Markup:
    """Return a row of a table: its own head, then numbers."""
    return tag("tr", tag("th", head, scope="row"), [tag("td", text, cls="num") for text in numbers])


def cards(
    heads: Sequence[str], rows: Sequence[Sequence[str]], classes: Mapping[str, str | None] | None = None
) -> Markup:
    """Return a table of text whose rows become cards where the page is narrow; `classes` by the head of a column."""
    of = classes or {}
    body = [
        tag("tr", [tag("td", text, data_label=head, cls=of.get(head)) for head, text in zip(heads, row, strict=True)])
        for row in rows
    ]
    return tag("div", table(heads, body, "cards"), cls="scroll")


def stretched(width: float, height: float, shapes: object, description: str) -> Markup:
    """Return a drawing that fills whatever holds it, both ways."""
    return tag(
        "svg",
        tag("title", description),
        shapes,
        viewBox=f"0 0 {width} {height}",
        preserveAspectRatio="none",
        role="img",
        aria_label=description,
    )


def picture(content: bytes, description: str, kind: str = "jpeg", **attributes: object) -> Markup:
    """Return an image that is part of the page."""
    source = f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
    return tag("img", src=source, alt=description, **attributes)


def document(title: str, body: object) -> Markup:
    """Return a whole page, which asks for nothing outside itself."""
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="color-scheme", content="light dark"),
        tag("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        tag("title", title),
        tag("link", rel="icon", href="data:,"),  # or browsers ask for /favicon.ico
        tag("style", Markup(style_sheet())),
    )
    return Markup("<!DOCTYPE html>\n" + tag("html", head, tag("body", tag("main", body)), lang="en") + "\n")


def style_sheet() -> str:
    """Return the style sheet of all pages."""
    return files("dualslam.report").joinpath("page.css").read_text(encoding="utf-8")


ROUNDING = 1e-9
"""Below this a number is what rounding in a double's last digits leaves of zero: a first submap "moved by 1e-20"."""


def number(value: float | None, digits: int = 3) -> str:
    """Return a number with so many significant digits, without exponents where a person would not want them."""
    if value is None or value != value:
        return "-"
    if abs(value) < ROUNDING:
        return "0"
    if 1e-4 <= abs(value) < 1e6:
        text = f"{value:.{digits}g}"
        return f"{value:.0f}" if "e" in text else text
    return f"{value:.{digits - 1}e}"


def duration(ms: float) -> str:
    """Return a time with its unit: milliseconds, or seconds from one on."""
    return f"{number(ms / 1000)} s" if ms >= 1000 else f"{number(ms)} ms"


def coordinate(value: float) -> str:
    """Return a coordinate of a drawing, as short as its pixels need."""
    text = f"{value:.1f}"
    return text[:-2] if text.endswith(".0") else text


def _attribute_name(key: str) -> str:
    if key == "cls":
        return "class"
    if key == "viewBox" or key == "preserveAspectRatio":
        return key
    return key.rstrip("_").replace("_", "-")


def _plain(value: object) -> str:
    return coordinate(value) if isinstance(value, float) else str(value)
