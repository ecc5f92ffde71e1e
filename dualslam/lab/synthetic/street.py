"""The street scene: a winding road between houses, with trees, poles, signs, parked cars, fences, hills and clouds."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from dualslam.core.types import FloatArray
from dualslam.lab.synthetic import street_materials as paint
from dualslam.lab.synthetic.painter import Painter
from dualslam.lab.synthetic.road import PAVEMENT_END_M, ROAD_HALF_WIDTH_M, Decal, GroundTile, Road
from dualslam.lab.synthetic.surfaces import Scene, Surface, box, wall

_TILE_M = 16.0
_AHEAD_M = 170.0
BEHIND_M = 12.0


def make_street(seed: int, length_m: float) -> tuple[Scene, Road]:
    """Build a street along which a camera can drive from arc length 0 to `length_m`.

    Parameters
    ----------
    seed : int
    length_m : float
        Way driven, metres; the street reaches further than one sees from there.

    Returns
    -------
    Scene, Road
    """
    rng = np.random.default_rng([seed, 0x57E3])
    road = Road(rng, length_m + _AHEAD_M)
    surfaces = ground(rng, road)
    for side in (-1.0, 1.0):
        surfaces += houses(rng, road, side)
        surfaces += back_row(rng, road, side)
        surfaces += furniture(rng, road, side)
    surfaces += horizon()
    return Scene(tuple(surfaces), background=240, seed=seed), road


def _flat(
    x: float, z: float, width: float, depth: float, material: object, texels_per_m: float, y: float = 0
) -> Surface:
    """Return a piece of ground whose texture's top left is at (x, z), z falling down the texture."""
    sides = np.array([width, 0, 0.0]), np.array([0, 0, -depth])
    return Surface(np.array([x, y, z]), *sides, material, texels_per_m)  # type: ignore[arg-type]


def ground(rng: np.random.Generator, road: Road) -> list[Surface]:
    """Tile the plane around the road; beyond, one coarse field a finger's breadth lower."""
    s = np.arange(-BEHIND_M, road.length_m, 0.5)
    line = road.centre(s)
    decals = []
    kinds = (("patch", 0.05, 0.5, 1.8), ("cover", 0.05, 0.33, 0.36), ("shadow", 0.05, 1.5, 4), ("crack", 0.15, 1, 3))
    for kind, per_m, low, high in (*kinds, ("litter", 0.1, 0.3, 1.5)):
        for _ in range(int(per_m * road.length_m)):
            reach = PAVEMENT_END_M if kind in ("litter", "shadow", "crack") else ROAD_HALF_WIDTH_M - 0.5
            x, z = road.beside(rng.uniform(-BEHIND_M, road.length_m), rng.uniform(-reach, reach))
            decals.append(Decal(kind, float(x), float(z), float(rng.uniform(low, high)), int(rng.integers(1 << 31))))
    surfaces = []
    reach = 9.0 + _TILE_M / 2
    cells = {(int(i), int(j)) for i, j in np.floor((line[:, None] + _offsets(reach)) / _TILE_M).reshape(-1, 2)}
    for i, j in sorted(cells):
        x, z = i * _TILE_M, (j + 1) * _TILE_M
        middle = np.array([x + _TILE_M / 2, z - _TILE_M / 2])
        # With a margin: a polyline ends in a round cap, which must not fall into the tile.
        close = np.flatnonzero(np.abs(line - middle).max(1) < _TILE_M)
        near_line = line[close[0] : close[-1] + 1] if len(close) else np.zeros((0, 2))
        if len(near_line) < 3:
            continue
        here = tuple(d for d in decals if max(abs(d.x - middle[0]), abs(d.z - middle[1])) < _TILE_M / 2 + d.radius_m)
        surfaces.append(_flat(x, z, _TILE_M, _TILE_M, GroundTile(near_line, here, x, z), 56))
    low, high = line.min(0) - 300, line.max(0) + 300
    surfaces.append(_flat(low[0], high[1], high[0] - low[0], high[1] - low[1], _field, 1.2, 0.03))
    return surfaces


def _offsets(reach: float) -> FloatArray:
    """Return a 5 x 5 stencil of steps that covers a square of half size `reach`."""
    steps = np.linspace(-reach, reach, 5)
    return np.stack(np.meshgrid(steps, steps), -1).reshape(1, 25, 2)


def _field(p: Painter) -> None:
    """Distant grass and soil."""
    p.fill(98, rough=14, smooth=14)


def houses(rng: np.random.Generator, road: Road, side: float) -> list[Surface]:
    """Line one side of the road with houses of different width, height and setback, with gaps between them."""
    surfaces: list[Surface] = []
    s = -BEHIND_M + rng.uniform(0, 6)
    while s < road.length_m - 14:
        width, height = rng.uniform(7, 15), rng.uniform(4.5, 11.5)
        setback = PAVEMENT_END_M + rng.choice((0.6, 1.5, 3.5, 6.0)) + rng.uniform(0, 1)
        surfaces += _house(rng, road, side, s, width, height, setback, rng.uniform(8, 12))
        s += width
        if rng.random() < 0.5:
            gap = rng.uniform(2, 9)
            if rng.random() < 0.7 and s + gap < road.length_m - 14:
                a, b = _ends(road, side, s, s + gap, setback - 0.3)
                kind = rng.random()
                height = rng.uniform(0.8, 1.9)
                if kind < 0.5:
                    surfaces.append(wall(a, b, 0, height, paint.pickets, 60, cutout=True))
                else:
                    surfaces.append(wall(a, b, 0, height, paint.hedge if kind < 0.8 else paint.masonry, 60))
            s += gap
    return surfaces


def _ends(road: Road, side: float, s0: float, s1: float, lateral: float) -> tuple[FloatArray, FloatArray]:
    """Return the left and right end of a front along the road, as seen from the road."""
    a, b = road.beside(s0, side * lateral), road.beside(s1, side * lateral)
    return (a, b) if side < 0 else (b, a)


def _house(
    rng: np.random.Generator,
    road: Road,
    side: float,
    s: float,
    width: float,
    height: float,
    lateral: float,
    depth: float,
    relief: bool = True,
) -> list[Surface]:
    """Return a house: front, two sides, roof, and what stands out of the front; nothing where a bend leaves no room."""
    left, right = _ends(road, side, s, s + width, lateral)
    if np.linalg.norm(right - left) < 4:
        return []
    along = (right - left) / np.linalg.norm(right - left)
    inward = np.array([-along[1], along[0]])  # the front's normal, away from the road
    back_left, back_right = left + inward * depth, right + inward * depth
    faces = [
        wall(left, right, 0, height, paint.facade, 50),
        wall(back_left, left, 0, height, paint.gable, 40),
        wall(right, back_right, 0, height, paint.gable, 40),
    ]
    if rng.random() < 0.7:
        rise, eaves = rng.uniform(2, 4), 0.4
        corner = left - inward * eaves - along * 0.2
        origin = np.array([corner[0], -height + 0.2, corner[1]])
        up = np.array([inward[0] * (depth / 2 + eaves), -rise, inward[1] * (depth / 2 + eaves)])
        across = np.array([along[0], 0, along[1]]) * (np.linalg.norm(right - left) + 0.4)
        faces.append(Surface(origin + up, across, -up, paint.roof, 28, 0.95, two_sided=True))
    if not relief:
        return faces
    yaw = float(np.arctan2(-along[1], along[0]))
    span = float(np.linalg.norm(right - left))

    def out(x: float, protrusion: float, size: tuple[float, float], bottom: float, *materials: object) -> None:
        middle = left + along * (x + size[0] / 2) - inward * protrusion / 2
        faces.extend(box(middle, yaw, (size[0], protrusion, size[1]), bottom, materials, 55))  # type: ignore[arg-type]

    for _ in range(int(rng.integers(1, 4))):  # balconies, bays
        w, h = rng.uniform(1.6, 3.2), rng.uniform(0.9, 1.1)
        x, bottom = rng.uniform(0.2, max(0.3, span - w)), rng.choice((2.9, 5.9)) if height > 8 else 2.9
        material = paint.pickets if rng.random() < 0.3 else paint.panel
        out(
            x,
            rng.uniform(0.6, 1.2),
            (w, h),
            bottom,
            paint.plain if material is paint.pickets else material,
            *[paint.plain] * 5,
        )
    if rng.random() < 0.6:  # a porch
        out(rng.uniform(0, span - 2), rng.uniform(0.8, 1.5), (1.9, 2.6), 0, paint.gable, paint.plain, None, paint.plain)
    if rng.random() < 0.7:  # a hanging sign, across the pavement
        x = rng.uniform(0.5, span - 0.5)
        a = left + along * x - inward * 0.15
        size = rng.uniform(0.6, 1.1)
        faces.append(wall(a, a - inward * size, 2.6, 2.6 + size, paint.panel, 90, two_sided=True))
    if rng.random() < 0.5:  # a chimney
        middle = left + along * rng.uniform(1, span - 1) + inward * depth * 0.4
        faces.extend(box(middle, yaw, (0.7, 0.7, 3.5), height, [paint.masonry] * 4, 40))
    return faces


def back_row(rng: np.random.Generator, road: Road, side: float) -> list[Surface]:
    """Return taller blocks and big trees that look over the houses and through their gaps."""
    surfaces: list[Surface] = []
    for s in np.arange(0, road.length_m - 30, 21.0):
        lateral, s0 = rng.uniform(32, 65), s + rng.uniform(0, 6)
        if rng.random() < 0.5:
            size = rng.uniform(10, 16), rng.uniform(9, 19)
            surfaces += _house(rng, road, side, s0, *size, lateral, 12.0, relief=False)
        else:
            surfaces += _tree(rng, road.beside(s0, side * lateral * 0.8), rng.uniform(7, 12), 3.2, 9)
    return surfaces


def _tree(rng: np.random.Generator, foot: FloatArray, height: float, spread: float, n_cards: int) -> list[Surface]:
    """Return a trunk and a crown of leafy cards that look in all directions."""
    radius = 0.035 * height
    surfaces = box(foot, rng.uniform(0, 1.5), (radius, radius, height * 0.75), 0, [paint.bark] * 4, 60)
    for _ in range(n_cards):
        size = spread * rng.uniform(0.6, 0.95)
        middle = np.array([foot[0], -height * 0.72, foot[1]]) + rng.normal(0, 0.3, 3) * (spread, spread * 0.8, spread)
        side_s, side_t = np.linalg.qr(rng.normal(size=(3, 3)))[0][:2] * size
        origin = middle - (side_s + side_t) / 2
        shade = float(rng.uniform(0.6, 1.2))
        density = min(70.0, 150 / size)
        surfaces.append(Surface(origin, side_s, side_t, paint.twigs, density, shade, cutout=True, two_sided=True))
    return surfaces


def furniture(rng: np.random.Generator, road: Road, side: float) -> list[Surface]:
    """Return what stands between the road and the houses."""
    surfaces: list[Surface] = []
    s = -BEHIND_M + rng.uniform(2, 8)
    while s < road.length_m - 6:
        kerb = ROAD_HALF_WIDTH_M + rng.uniform(0.5, 0.9)
        foot, heading = road.beside(s, side * kerb), float(road.heading(s))
        kind = rng.random()
        if kind < 0.38:
            surfaces += _tree(rng, foot, rng.uniform(4, 7.5), rng.uniform(1.8, 2.8), 8)
            s += rng.uniform(5, 11)
        elif kind < 0.6:
            surfaces += _car(rng, road.beside(s + 2, side * (ROAD_HALF_WIDTH_M - 0.45)), heading)
            s += rng.uniform(5.2, 9)
        elif kind < 0.75:
            height = rng.uniform(2.4, 3.2)
            surfaces += box(foot, heading, (0.08, 0.08, height), 0, [paint.plain] * 4, 60)
            surfaces += _sign(rng, foot, heading, height)
            s += rng.uniform(4, 9)
        elif kind < 0.9:
            height = rng.uniform(6, 8)
            surfaces += box(foot, heading, (0.16, 0.16, height), 0, [paint.bark] * 4, 60)
            a = np.array([np.cos(heading), -np.sin(heading)]) * -side
            surfaces.append(wall(foot, foot + a * 2, height - 0.25, height - 0.1, paint.plain, 40, two_sided=True))
            surfaces.append(wall(foot - a * 0.2, foot + a * 0.2, 1.4, 2.0, paint.panel, 110, two_sided=True))
            s += rng.uniform(4, 9)
        else:
            size = (rng.uniform(0.6, 1.4), rng.uniform(0.5, 0.9), rng.uniform(0.8, 1.6))
            surfaces += box(
                road.beside(s, side * (kerb + 0.7)),
                heading,
                size,
                0,
                [paint.panel, paint.plain] * 2 + [paint.plain],
                70,
            )
            s += rng.uniform(3, 8)
    return surfaces


def _sign(rng: np.random.Generator, foot: FloatArray, heading: float, height: float) -> list[Surface]:
    """Return a traffic sign that faces the traffic, in front of its post."""
    size = rng.uniform(0.5, 0.8)
    right = np.array([np.cos(heading), -np.sin(heading)])
    middle = foot - np.array([np.sin(heading), np.cos(heading)]) * 0.08
    a, b = middle - right * size / 2, middle + right * size / 2
    round_ = bool(rng.random() < 0.5)
    signs = [
        wall(
            a, b, height - size, height, paint.round_sign if round_ else paint.panel, 120, cutout=round_, two_sided=True
        )
    ]
    if rng.random() < 0.6:
        signs.append(wall(a, b, height - size * 1.6, height - size * 1.05, paint.panel, 120, two_sided=True))
    return signs


def _car(rng: np.random.Generator, middle: FloatArray, heading: float) -> list[Surface]:
    """Return a parked car: a body and a cabin."""
    length, height = rng.uniform(3.8, 4.6), rng.uniform(0.75, 0.95)
    yaw = heading - np.pi / 2  # the box's length lies along its own x
    body = [paint.car_side, paint.car_end, paint.car_side, paint.car_end, paint.plain]
    surfaces = box(middle, yaw, (length, 1.7, height), 0.12, body, 75)
    glass = [paint.car_glass] * 4 + [paint.plain]
    back = np.array([np.sin(heading), np.cos(heading)]) * 0.3
    surfaces += box(middle - back, yaw, (length * 0.52, 1.45, 0.55), 0.12 + height, glass, 75)
    return [replace(surface, parked=True) for surface in surfaces]


def horizon() -> list[Surface]:
    """Return the clouds overhead and a ring of hills, both at infinity."""
    reach = 26.0
    sky = Surface(
        np.array([-reach, -1.0, -reach]),
        np.array([2 * reach, 0, 0.0]),
        np.array([0, 0, 2 * reach]),
        paint.clouds,
        32,
        infinite=True,
    )
    hills = []
    angles = np.arange(7) * 2 * np.pi / 6
    corners = np.stack([np.sin(angles), np.cos(angles)], 1) * 10
    for a, b in itertools.pairwise(corners):
        low = wall(a, b, -0.2, 1.1, paint.skyline, 80, cutout=True)
        hills.append(Surface(low.origin, low.side_s, low.side_t, low.material, 80, 1.0, cutout=True, infinite=True))
    return [*hills, sky]
