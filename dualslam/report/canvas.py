"""A drawing to scale: SVG for the lines, HTML over it for the words, so that these are readable at any width."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualslam.core.types import FloatArray
from dualslam.report.markup import Markup, coordinate, number, tag

WIDTH = 1000.0
ASPECT_RANGE = (1.25, 1.8)
MARGIN = 0.07
_EDGE_PERCENT = 9.0
_FOOT_PERCENT = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class Canvas:
    """Maps the plane of a drawing (right, up) to the units of an SVG."""

    corner: FloatArray  # (2,): lowest coordinates that are shown
    size: FloatArray  # (2,)

    @classmethod
    def around(cls, low: FloatArray, high: FloatArray) -> Canvas:
        """Return a canvas that shows a box with some margin, in a shape that fits a page."""
        span = np.maximum(high - low, 1e-9 * max(1.0, float(np.abs([low, high]).max())))
        span = np.maximum(span, 0.02 * span.max()) * (1 + 2 * MARGIN)
        aspect = float(np.clip(span[0] / span[1], *ASPECT_RANGE))
        size = np.array([max(span[0], aspect * span[1]), 0.0])
        size[1] = size[0] / aspect
        return cls((low + high) / 2 - size / 2, size)

    @property
    def height(self) -> float:
        """Height of the SVG; its width is `WIDTH`."""
        return float(WIDTH * self.size[1] / self.size[0])

    def to_svg(self, uv: FloatArray) -> FloatArray:
        """Return SVG coordinates (N, 2) of points (N, 2) of the plane."""
        scaled = (np.asarray(uv, float) - self.corner) * (WIDTH / self.size[0])
        return np.column_stack([scaled[:, 0], self.height - scaled[:, 1]])

    def to_percent(self, uv: FloatArray) -> tuple[float, float]:
        """Return left and top of one point (2,), in percent of the drawing."""
        x, y = self.to_svg(np.asarray(uv, float)[None])[0]
        return 100 * float(x) / WIDTH, 100 * float(y) / self.height

    def line(self, uv: FloatArray, cls: str, title: str | None = None) -> Markup:
        """Return a line through points (N, 2); a single point becomes a dot."""
        xy = self.to_svg(uv)
        steps = [f"{coordinate(x)} {coordinate(y)}" for x, y in xy.tolist()]
        d = f"M{steps[0]}h0" if len(steps) == 1 else "M" + "L".join(steps)
        return tag("path", None if title is None else tag("title", title), cls=cls, d=d)

    def dots(self, uv: FloatArray, cls: str) -> Markup:
        """Return points (N, 2), those outside of the drawing left out."""
        xy = self.to_svg(uv)
        xy = xy[(xy > 0).all(axis=1) & (xy < [WIDTH, self.height]).all(axis=1)]
        return tag("path", cls=cls, d="".join(f"M{coordinate(x)} {coordinate(y)}h0" for x, y in xy.tolist()))

    def label(self, uv: FloatArray, text: object, cls: str, title: str | None = None) -> Markup:
        """Return words that stand at a point (2,)."""
        left, top = self.to_percent(uv)
        side = ""
        if len(str(text)) > 1:  # near an edge, words stand on its inner side; a mark stays where it is
            side = " inward-right" if left < _EDGE_PERCENT else " inward-left" if left > 100 - _EDGE_PERCENT else ""
            side += " above" if top > 100 - _FOOT_PERCENT else ""
        return tag("span", text, cls=f"at {cls}{side}", style=f"left:{left:.2f}%;top:{top:.2f}%", title=title)

    def scale_bar(self, unit: str, drawn: FloatArray) -> Markup:
        """Return a bar of a round length, in the lower corner that points (N, 2) leave free."""
        length = nice_step(float(self.size[0]) / 5)
        words = f"{number(length)} {unit}" if unit else units_of_map(length)
        xy = self.to_svg(drawn) / [WIDTH, self.height]
        low = xy[xy[:, 1] > 0.75, 0]
        side = "right" if (low < 0.35).sum() > (low > 0.65).sum() else "left"
        return tag("span", words, cls=f"scale-bar {side}", style=f"width:{100 * length / self.size[0]:.2f}%")

    def draw(self, shapes: object, words: object, description: str) -> Markup:
        """Return the drawing."""
        svg = tag(
            "svg",
            tag("title", description),
            shapes,
            viewBox=f"0 0 {coordinate(WIDTH)} {coordinate(self.height)}",
            role="img",
            aria_label=description,
        )
        return tag("div", svg, words, cls="canvas")


def units_of_map(length: float) -> str:
    """Return a length in words, where no scale is known."""
    return f"{number(length)} unit{'' if length == 1 else 's'} of the map"


def nice_step(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above `value` (> 0)."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step * power for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)))


def ticks(low: float, high: float, at_most: int = 8) -> list[float]:
    """Return round numbers in a range, about `at_most` of them or fewer."""
    needed = max(high - low, 1e-9) / at_most
    power = 10.0 ** np.floor(np.log10(needed))
    step = float(next(f * power for f in (1, 2, 5, 10) if f * power >= needed * (1 - 1e-9)))
    first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
    return [i * step for i in range(first, last + 1)]
