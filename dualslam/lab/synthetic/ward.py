"""A hospital ward: white walls, a plain floor, and few things with edges. Corners are scarce in most of its images."""

from __future__ import annotations

import numpy as np

from dualslam.lab.synthetic.painter import Painter
from dualslam.lab.synthetic.path import Walk
from dualslam.lab.synthetic.surfaces import Scene, Surface, box, wall
from dualslam.lab.synthetic.traps import Place

HALF_SIZE_M = (4.0, 3.0)
HEIGHT_M = 2.8
DENSITY = 200.0  # texels per metre
BED_M = (1.0, 2.0, 0.55)
"""Width, length, height."""


def make_ward(seed: int, n_s: float) -> Place:
    """Build a ward with beds along two of its walls, and walk round its middle for `n_s` seconds."""
    rng = np.random.default_rng([seed, 0x3A2D])
    hx, hz = HALF_SIZE_M
    across = np.array([2 * hx, 0, 0])
    surfaces = [
        Surface(np.array([-hx, 0, hz]), across, np.array([0, 0, -2 * hz]), _floor, DENSITY, 0.95),
        Surface(np.array([-hx, -HEIGHT_M, -hz]), across, np.array([0, 0, 2 * hz]), _ceiling, DENSITY / 2, 0.95),
    ]
    corners = [np.array(c) for c in ((-hx, hz), (hx, hz), (hx, -hz), (-hx, -hz))]
    surfaces += [wall(corners[i], corners[(i + 1) % 4], 0, HEIGHT_M, _white, DENSITY) for i in range(4)]
    for z in (-hz + BED_M[1] / 2 + 0.05, hz - BED_M[1] / 2 - 0.05):
        for x in (-2.0, 2.0):
            middle = np.array([x + rng.uniform(-0.6, 0.6), z])
            surfaces += box(middle, rng.uniform(-0.06, 0.06), BED_M, 0.15, [_metal] * 4 + [_linen] * 2, DENSITY)
    return Place(Scene(tuple(surfaces), background=200, seed=seed), Walk(rng, n_s, (hx - 1.2, hz - 1.2)), in_hand=True)


def _white(p: Painter) -> None:
    """A painted wall: shading, a handrail, a skirting board, a door, a few switches and notices."""
    width, height = p.size_m
    p.fill(p.uniform(205, 225), rough=0.4, smooth=p.uniform(2, 4))
    p.rect(0, height - 0.1, width, 0.1, 185)
    p.rect(0, height - 0.95, width, 0.1, p.uniform(185, 200))
    x = p.uniform(0.3, width - 1.4)
    p.rect(x, height - 2.1, 1.0, 2.0, p.uniform(200, 210))
    p.frame(x, height - 2.1, 1.0, 2.0, 0.05, 190)
    p.rect(x + 0.85, height - 1.05, 0.1, 0.03, 90)
    for _ in range(3):
        x, y = p.uniform(0.1, width - 0.4), height - p.uniform(1.1, 1.9)
        if p.chance(0.5):
            p.rect(x, y, 0.09, 0.09, 240)
            p.frame(x, y, 0.09, 0.09, 0.006, 190)
        else:
            p.rect(x, y, 0.21, 0.3, 240)
            p.glyphs(x + 0.02, y + 0.03, 0.17, 0.22, p.uniform(90, 150), 5)


def _floor(p: Painter) -> None:
    """Linoleum with its seams."""
    p.fill(p.uniform(165, 185), rough=0.6, smooth=p.uniform(2, 5))
    p.bricks(4.0, 2.0, 0.5, -2)


def _ceiling(p: Painter) -> None:
    """Panels and lamps."""
    p.fill(225, rough=0.2, smooth=1.0)
    p.bricks(1.2, 0.6, 0.5, -4)
    for _ in range(4):
        p.rect(p.uniform(0.3, p.size_m[0] - 1.5), p.uniform(0.3, p.size_m[1] - 0.9), 1.2, 0.6, 250)


def _metal(p: Painter) -> None:
    """Enamelled panels, with a handle."""
    width, height = p.size_m
    p.fill(p.uniform(190, 215), rough=0.3, smooth=1.5)
    p.frame(0, 0, width, height, 0.02, 185)
    p.rect(width * 0.35, height * 0.2, width * 0.3, 0.02, 150)


def _linen(p: Painter) -> None:
    """A made bed: a pillow, a folded blanket."""
    width, height = p.size_m
    p.fill(p.uniform(215, 235), rough=0.3, smooth=3)
    p.rect(0, height * 0.45, width, height * 0.55, p.uniform(160, 200), 1.0)
    p.frame(width * 0.15, height * 0.05, width * 0.7, height * 0.2, 0.01, 195)
