"""Worlds in which a map goes wrong and nothing shows: things that repeat, starts at rest, a bench that leaves the view.

`board` and `parked` repeat at a known period. A camera slides past them and misses some frames (`--corrupt`, an event).
After the gap it sees the same as before, one period on. `takeoff`, `standstill` and `hover` begin badly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from dualslam.core.types import FloatArray
from dualslam.lab.synthetic import room_materials, street_materials
from dualslam.lab.synthetic.circuit import make_eight
from dualslam.lab.synthetic.path import Drive, Sway, Walk, pose
from dualslam.lab.synthetic.room import HALF_SIZE_M, make_room
from dualslam.lab.synthetic.surfaces import Scene, Surface, box, wall

BOARD_PERIOD_M = 0.25
BOARD_SPEED_M_S = 0.25
"""So that a second without frames is one period."""
CAR_PERIOD_M = 5.5
CAR_SPEED_M_S = 5.5
REST_S = 1.5
"""That a start at rest takes to come to its speed."""
HOVER_S = 4.0
BENCH_M = (0.9, 1.15)
"""Side and height of the bench; the camera starts a sixth of a metre above it."""
TEXTURES_FROM = 2_000_000


class _Path(Protocol):
    def T_world_cam(self, t_s: float) -> FloatArray: ...


@dataclass(frozen=True, slots=True)
class Place:
    """A world, the way through it, and whether its camera is one in the hand."""

    scene: Scene
    path: _Path
    in_hand: bool


@dataclass(frozen=True, slots=True)
class _FromRest:
    """A path that is at rest for `rest_s`, and whose time then begins slowly. `tremor`: what moves all the while."""

    path: _Path
    rest_s: float
    tremor: Callable[[float], FloatArray]

    def T_world_cam(self, t_s: float) -> FloatArray:
        begun = max(t_s - self.rest_s, 0.0)
        own_s = begun**2 / (2.0 * REST_S) if begun < REST_S else begun - REST_S / 2.0
        T_world_cam = self.path.T_world_cam(own_s)
        dx = self.tremor(t_s)
        return T_world_cam @ pose(dx[:3], *dx[3:])


@dataclass(frozen=True, slots=True)
class _Slide:
    """A camera that looks sideways at what it passes at a steady speed along x, `height_m` over the ground."""

    speed_m_s: float
    height_m: float
    sway: Callable[[float], FloatArray]

    def T_world_cam(self, t_s: float) -> FloatArray:
        dx = self.sway(t_s)
        return pose(np.array([self.speed_m_s * t_s, -self.height_m, 0.0]) + dx[:3], *dx[3:])


@dataclass(frozen=True, slots=True)
class _TakeOff:
    """At rest over the bench, then up and forward, and on round the room."""

    walk: Walk
    sway: Callable[[float], FloatArray]

    def T_world_cam(self, t_s: float) -> FloatArray:
        share = float(np.clip((t_s - 0.3) / 3.0, 0.0, 1.0))
        share = share * share * (3.0 - 2.0 * share)
        there = self.walk.T_world_cam(0.0)
        here = there.copy()
        here[1, 3] = -BENCH_M[1] - 1.0 / 6.0
        up = here.copy()
        up[:3, 3] += share * (there[:3, 3] - here[:3, 3]) + 0.6 * share * there[:3, 0] * [1, 0, 1]
        dx = self.sway(t_s)
        return up @ pose(dx[:3], *dx[3:])


def make_board(seed: int, n_s: float) -> Place:
    """Build a board of prints that are all the same, `BOARD_PERIOD_M` apart, and slide along it for `n_s` seconds.

    On every second one stands a carton; so it is two periods after which all is as it was.
    """
    rng = np.random.default_rng([seed, 0xB0A])
    surfaces = []
    for column in range(int((BOARD_SPEED_M_S * n_s + 5.0) / BOARD_PERIOD_M)):
        for row in range(9):
            left = -2.5 + column * BOARD_PERIOD_M
            print_ = wall(
                (left, 1.3),
                (left + BOARD_PERIOD_M, 1.3),
                0.4 + row * BOARD_PERIOD_M,
                0.4 + (row + 1) * BOARD_PERIOD_M,
                room_materials.picture,
                400.0,
            )
            surfaces.append(replace(print_, texture=TEXTURES_FROM))
            if (row + column) % 2:  # something to see depth by
                size, cartons = (0.13, 0.12, 0.13), [room_materials.carton] * 6
                carton = box((left + 0.12, 1.2), 0.0, size, 0.46 + row * BOARD_PERIOD_M, cartons, 400.0)
                surfaces += [replace(face, texture=TEXTURES_FROM + 1 + i) for i, face in enumerate(carton)]
    path = _Slide(BOARD_SPEED_M_S, 1.5, Sway(rng, [0.01, 0.01, 0.03, 0.01, 0.01, 0.01], (0.15, 0.6)))
    return Place(Scene(tuple(surfaces), 150, seed), path, in_hand=True)


def make_parked(seed: int, n_s: float) -> Place:
    """Build a row of like cars, `CAR_PERIOD_M` apart, before a plain wall, and drive past, looking at them."""
    rng = np.random.default_rng([seed, 0xCA2])
    length = CAR_SPEED_M_S * n_s + 40.0
    ground = Surface(
        np.array([-20.0, 0.0, 12.0]),
        np.array([length, 0, 0]),
        np.array([0, 0, -14.0]),
        street_materials.plain,
        30,
    )
    behind = wall((-20.0, 9.0), (length - 20.0, 9.0), 0.0, 6.0, street_materials.plain, 30.0)
    side, end = street_materials.car_side, street_materials.car_end
    glass = street_materials.car_glass
    car = box((0.0, 6.0), 0.0, (4.2, 1.7, 0.85), 0.2, [side, end, side, end, side], 160)
    car += box((0.1, 6.0), 0.0, (2.3, 1.5, 0.55), 1.05, [glass, glass, glass, glass, side], 160)
    car = [replace(surface, texture=TEXTURES_FROM + i) for i, surface in enumerate(car)]
    surfaces = [ground, behind]
    for n in range(int(length / CAR_PERIOD_M)):
        ahead = np.array([-20.0 + n * CAR_PERIOD_M, 0.0, 0.0])
        surfaces += [replace(surface, origin=surface.origin + ahead) for surface in car]
    path = _Slide(CAR_SPEED_M_S, 1.5, Sway(rng, [0.02, 0.01, 0.05, 0.004, 0.004, 0.003], (0.2, 0.9)))
    return Place(Scene(tuple(surfaces), 235, seed), path, in_hand=False)


def make_takeoff(seed: int, n_s: float) -> Place:
    """Build a room and a textured bench in it, from which the camera takes off."""
    rng = np.random.default_rng([seed, 0x7A0])
    walk = Walk(rng, n_s, (HALF_SIZE_M[0] - 1.3, HALF_SIZE_M[1] - 1.3))
    x, _, z = walk.T_world_cam(0.0)[:3, 3]
    forward = walk.T_world_cam(0.0)[[0, 2], 2]
    x, z = np.array([x, z]) + 0.3 * forward / np.linalg.norm(forward)
    room, (side, height) = make_room(seed), BENCH_M
    bench = Surface(
        np.array([x - side / 2, -height, z + side / 2]),
        np.array([side, 0, 0]),
        np.array([0, 0, -side]),
        room_materials.table_top,
        900.0,
    )
    sway = Sway(rng, [0.004, 0.004, 0.004, 0.006, 0.006, 0.006], (0.3, 1.5))
    return Place(replace(room, surfaces=(*room.surfaces, bench)), _TakeOff(walk, sway), in_hand=True)


def make_standstill(seed: int, n_s: float) -> Place:
    """Build a figure of eight, and set out on its bend from rest."""
    rng = np.random.default_rng([seed, 0x57A])
    world, road = make_eight(seed)
    tremor = Sway(rng, [0.001, 0.001, 0.001, 0.0005, 0.0005, 0.0005], (1.0, 4.0))
    return Place(world, _FromRest(Drive(road, rng, n_s, speed_m_s=10.0), 1.0, tremor), in_hand=False)


def make_hover(seed: int, n_s: float) -> Place:
    """Build a room, and hover in it for `HOVER_S` seconds, by millimetres, before walking on."""
    rng = np.random.default_rng([seed, 0x40E])
    walk = Walk(rng, n_s, (HALF_SIZE_M[0] - 1.3, HALF_SIZE_M[1] - 1.3))
    tremor = Sway(rng, [0.004, 0.004, 0.004, 0.01, 0.01, 0.006], (0.3, 1.5))
    return Place(make_room(seed), _FromRest(walk, HOVER_S, tremor), in_hand=True)


TRAPS: dict[str, Callable[[int, float], Place]] = {
    "board": make_board,
    "parked": make_parked,
    "takeoff": make_takeoff,
    "standstill": make_standstill,
    "hover": make_hover,
}
