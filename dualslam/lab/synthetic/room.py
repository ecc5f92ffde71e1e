"""The room scene: walls, floor and ceiling, furniture along the walls, a laid table in the middle, and many things."""

from __future__ import annotations

import numpy as np

from dualslam.core.types import FloatArray
from dualslam.lab.synthetic import room_materials as paint
from dualslam.lab.synthetic.surfaces import Material, Scene, Surface, box, wall

HALF_SIZE_M = (3.3, 2.8)
_HEIGHT_M = 2.7
_DENSITY = 270.0  # texels per metre: the camera is rarely nearer than two metres


def make_room(seed: int) -> Scene:
    """Build a furnished room around the origin, whose middle is free to walk except for a low table."""
    rng = np.random.default_rng([seed, 0x400])
    hx, hz = HALF_SIZE_M
    floor = Surface(np.array([-hx, 0, hz]), np.array([2 * hx, 0, 0]), np.array([0, 0, -2 * hz]), paint.boards, 220, 0.9)
    above = Surface(
        np.array([-hx, -_HEIGHT_M, -hz]), np.array([2 * hx, 0, 0]), np.array([0, 0, 2 * hz]), paint.ceiling, 110, 0.85
    )
    surfaces = [floor, above, *_carpet(rng)]
    corners = [np.array(c) for c in ((-hx, hz), (hx, hz), (hx, -hz), (-hx, -hz))]
    doors = int(rng.integers(0, 4))
    for i in range(4):
        left, right = corners[i], corners[(i + 1) % 4]
        material = paint.tiles if rng.random() < 0.3 else paint.plaster
        surfaces.append(wall(left, right, 0, _HEIGHT_M, material, _DENSITY))
        surfaces += along_wall(rng, left, right, has_door=i == doors)
    surfaces += _table(rng)
    return Scene(tuple(surfaces), background=128, seed=seed)


def _carpet(rng: np.random.Generator) -> list[Surface]:
    """Return a carpet just over the floor."""
    w, d = rng.uniform(2.4, 3.2), rng.uniform(1.8, 2.4)
    return [Surface(np.array([-w / 2, -0.012, d / 2]), np.array([w, 0, 0]), np.array([0, 0, -d]), paint.carpet, 200)]


def along_wall(
    rng: np.random.Generator, left: FloatArray, right: FloatArray, has_door: bool, tall: bool = True
) -> list[Surface]:
    """Return furniture that stands against a wall, and what hangs over it.

    Parameters
    ----------
    rng : numpy Generator
    left, right : (2,)
        World (x, z) of the wall's ends, as seen from its front.
    has_door : bool
    tall : bool
        Without, nothing stands higher than a sideboard, and nothing hangs.
    """
    surfaces: list[Surface] = []
    length = float(np.linalg.norm(right - left))
    along = (right - left) / length
    inward = np.array([along[1], -along[0]])  # into the room
    yaw = float(np.arctan2(-along[1], along[0]))

    def place(
        x: float, size: tuple[float, float, float], bottom: float, materials: list[Material], density: float
    ) -> None:
        middle = left + along * (x + size[0] / 2) + inward * size[1] / 2
        surfaces.extend(box(middle, yaw, size, bottom, materials, density))

    def hang(x: float, bottom: float, size: tuple[float, float], material: Material, out: float = 0.03) -> None:
        a = left + along * x + inward * out
        surfaces.append(wall(a, a + along * size[0], bottom, bottom + size[1], material, _DENSITY * 1.2))

    x = 0.5
    if has_door:
        hang(x, 0, (0.95, 2.1), paint.door, 0.02)
        x += 1.15
    while x < length - 0.9:
        kind, room = rng.random() if tall else 0.5, length - 0.45 - x
        width = min(rng.uniform(0.7, 1.5), room)
        if kind < 0.35:  # a book case
            depth, height = rng.uniform(0.25, 0.35), rng.uniform(1.0, 2.2)
            place(x, (width, depth, height), 0, [paint.books, *[paint.wood] * 4], _DENSITY)
            if height < 1.7:
                surfaces += _things(rng, left + along * x + inward * 0.12, along, width, height)
        elif kind < 0.75:  # a sideboard or worktop, things on it, a shelf and pictures above
            depth, height = rng.uniform(0.45, 0.6), rng.uniform(0.7, 0.95)
            place(x, (width, depth, height), 0, [paint.cupboard, *[paint.wood] * 3, paint.table_top], _DENSITY)
            surfaces += _things(rng, left + along * x + inward * depth * 0.35, along, width, height)
            surfaces += _things(rng, left + along * x + inward * depth * 0.75, along, width, height, 0.5)
            if tall and rng.random() < 0.5:
                shelf = rng.uniform(1.35, 1.6)
                place(x, (width, 0.22, 0.03), shelf, [paint.wood] * 6, _DENSITY)
                surfaces += _things(rng, left + along * x + inward * 0.12, along, width, shelf + 0.03)
            elif tall:
                hang(x + 0.1, 1.3, (width * 0.7, rng.uniform(0.5, 0.9)), paint.picture)
        elif kind < 0.88 and width > 0.9:
            hang(x, 0.9, (width, rng.uniform(1.1, 1.4)), paint.outdoors)
            place(x, (width, 0.2, 0.04), 0.84, [paint.wood] * 6, _DENSITY)
            surfaces += _things(rng, left + along * x + inward * 0.1, along, width, 0.88, 0.5)
        else:  # pictures, a chair before them
            hang(x, rng.uniform(1.0, 1.4), (width * 0.8, rng.uniform(0.5, 1.0)), paint.picture)
            surfaces += _chair(rng, left + along * (x + width / 2) + inward * 0.35, yaw + rng.uniform(-0.4, 0.4))
        x += width + rng.uniform(0.05, 0.4)
    return surfaces


def _things(
    rng: np.random.Generator, start: FloatArray, along: FloatArray, width: float, bottom: float, density: float = 1.0
) -> list[Surface]:
    """Return packets, machines and books that stand in a row."""
    surfaces: list[Surface] = []
    x = 0.05
    while x < width - 0.2:
        size = (rng.uniform(0.06, 0.28), rng.uniform(0.05, 0.15), rng.uniform(0.08, 0.34))
        if rng.random() < density:
            material = paint.appliance if rng.random() < 0.3 else paint.carton
            middle = start + along * (x + size[0] / 2)
            yaw = float(np.arctan2(-along[1], along[0])) + rng.uniform(-0.5, 0.5)
            surfaces += box(
                middle, yaw, size, bottom, [material, paint.carton, material, paint.carton, paint.wood], 320
            )
        x += size[0] + rng.uniform(0.03, 0.3)
    return surfaces


def _chair(rng: np.random.Generator, middle: FloatArray, yaw: float) -> list[Surface]:
    """Return a chair: legs, seat, back."""
    surfaces: list[Surface] = []
    c, s = np.cos(yaw), np.sin(yaw)
    for a in (-0.19, 0.19):
        for b in (-0.19, 0.19):
            foot = middle + np.array([c * a + s * b, -s * a + c * b])
            height = 0.95 if b > 0 else 0.43
            surfaces += box(foot, yaw, (0.04, 0.04, height), 0, [paint.wood] * 4, 200)
    surfaces += box(middle, yaw, (0.44, 0.44, 0.04), 0.43, [paint.wood] * 6, 200)
    back = middle + np.array([s, c]) * 0.2
    surfaces += box(back, yaw, (0.36, 0.03, rng.uniform(0.15, 0.3)), 0.65, [paint.wood] * 6, 200)
    return surfaces


def _table(rng: np.random.Generator) -> list[Surface]:
    """Return a table in the middle of the room, with things on it and chairs around."""
    surfaces: list[Surface] = []
    yaw, size = rng.uniform(-0.2, 0.2), (rng.uniform(1.2, 1.6), rng.uniform(0.75, 0.95))
    height = 0.72
    c, s = np.cos(yaw), np.sin(yaw)
    surfaces += box(
        (0, 0), yaw, (*size, 0.04), height - 0.04, [*[paint.wood] * 4, paint.table_top, paint.wood], _DENSITY
    )
    for a in (-1, 1):
        for b in (-1, 1):
            x, z = a * (size[0] / 2 - 0.06), b * (size[1] / 2 - 0.06)
            surfaces += box((c * x + s * z, -s * x + c * z), yaw, (0.06, 0.06, height - 0.04), 0, [paint.wood] * 4, 200)
    for _ in range(9):
        x, z = rng.uniform(-0.42, 0.42, 2) * size
        item = (rng.uniform(0.05, 0.22), rng.uniform(0.05, 0.15), rng.uniform(0.03, 0.3))
        middle = (c * x + s * z, -s * x + c * z)
        surfaces += box(middle, rng.uniform(0, 6.3), item, height, [paint.carton] * 5, 360)
    return surfaces
