"""Worlds in which another place looks the same: two corridors that are alike, and the same posters in two rooms.

Nothing is come back to: each loop that is closed here is false. Tracking has all that it needs to go from one place to
the other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline

from dualslam.core.types import FloatArray
from dualslam.lab.synthetic import room_materials as paint
from dualslam.lab.synthetic.path import Sway, pose
from dualslam.lab.synthetic.room import along_wall
from dualslam.lab.synthetic.surfaces import Scene, Surface, wall

HEIGHT_M = 2.6
DENSITY = 270.0
TEXTURES_FROM = 3_000_000
CORRIDOR_M = (2.4, 9.0)
"""Width and length."""
APART_M = 7.0
"""Between the middles of the two corridors."""
HALL_M = (14.0, 9.0)
"""Along x and z, at the end of both."""
ROOM_M = (6.4, 5.4)
"""Along x and z, of each of the two rooms with posters."""
OPENING_M = 2.0
"""Of the wall between them."""
POSTERS_M = ((-2.6, 1.5, 1.1), (-0.5, 1.1, 1.4), (1.2, 1.6, 1.0))
"""Left end against the middle of the room, width, height."""
WALK_M_S, SLIDE_M_S = 2.0, 0.8


class Way:
    """A hand-held camera carried along a line on the ground.

    Parameters
    ----------
    rng : numpy Generator
    points : (N, 2)
        World (x, z) that it passes.
    speed_m_s : float
    yaw_rad : float, optional
        Where it looks, on average; by default where it goes.
    """

    def __init__(
        self, rng: np.random.Generator, points: FloatArray, speed_m_s: float, yaw_rad: float | None = None
    ) -> None:
        s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        self._line, self._length_m = CubicSpline(s, points), float(s[-1])
        self._speed_m_s, self._yaw_rad = speed_m_s, yaw_rad
        self._gaze = Sway(rng, [0.12 if yaw_rad is None else 0.25, 0.05, 0.02], (0.05, 0.25))
        self._steps = Sway(rng, [0.006, 0.009, 0.006, 0.006, 0.006, 0.005], (0.7, 2.2))

    def T_world_cam(self, t_s: float) -> FloatArray:
        """Return the pose (4, 4) at time `t_s`; the line's end is where it stays."""
        s = float(np.clip(self._speed_m_s * t_s, 0.0, self._length_m))
        x, z = self._line(s)
        dx, dz = self._line(min(s + 0.6, self._length_m)) - self._line(max(s - 0.6, 0.0))
        yaw = float(np.arctan2(dx, dz)) if self._yaw_rad is None else self._yaw_rad
        sway, step = self._gaze(t_s), self._steps(t_s)
        angles = np.array([yaw, -0.06, 0.0]) + sway + step[3:]
        return pose(np.array([x, -1.5, z]) + step[:3], *angles)


def make_corridors(seed: int) -> tuple[Scene, Way]:
    """Build two corridors that are the same, textures and all, side by side on a hall, and the way through them."""
    width, length = CORRIDOR_M
    near, far = length, length + HALL_M[1]
    corridor = [replace(s, texture=TEXTURES_FROM + i) for i, s in enumerate(_corridor())]
    # The second is the first turned about: who comes out of the hall into it sees what the first has shown before.
    surfaces = [_moved(s, 0.0, np.array([-APART_M / 2, 0.0, 0.0])) for s in corridor]
    surfaces += [_moved(s, np.pi, np.array([APART_M / 2, 0.0, length])) for s in corridor]
    end = (APART_M + width) / 2, (APART_M - width) / 2
    surfaces.append(wall((end[0], 0.0), (end[1], 0.0), 0, HEIGHT_M, paint.tiles, DENSITY))
    rng = np.random.default_rng([seed, 0xC0D])
    half = HALL_M[0] / 2
    surfaces += _floor_and_ceiling((-half, half), (near, far))
    for left, right in (((-half, far), (half, far)), ((half, far), (half, near)), ((-half, near), (-half, far))):
        surfaces += _furnished(rng, np.array(left), np.array(right))
    edges = [half, APART_M / 2 + width / 2, APART_M / 2 - width / 2]
    pieces = ((edges[0], edges[1]), (edges[2], -edges[2]), (-edges[1], -edges[0]))
    surfaces += [wall((a, near), (b, near), 0, HEIGHT_M, paint.plaster, DENSITY) for a, b in pieces]
    x, turn = APART_M / 2, far - 2.6
    points = np.array(
        [(-x, 0.6), (-x, 0.5 * near), (-x, near), (-0.85 * x, near + 2.5), (-0.5 * x, turn - 0.6), (0, turn)], float
    )
    points = np.concatenate([points, points[-2::-1] * [-1, 1]])
    points[-1, 1] = 2.2  # short of the wall at the end
    return Scene(tuple(surfaces), background=128, seed=seed), Way(
        np.random.default_rng([seed, 0xC0A]), points, WALK_M_S
    )


def make_posters(seed: int) -> tuple[Scene, Way]:
    """Build two rooms, furnished each in its own way, with the same posters on the wall that the camera slides past."""
    (wide, deep), surfaces = ROOM_M, list[Surface]()
    for n, x in enumerate((-wide / 2, wide / 2)):
        rng = np.random.default_rng([seed, 0x905, n])
        left, right, back, front = x - wide / 2, x + wide / 2, -deep / 2, deep / 2
        surfaces += _floor_and_ceiling((left, right), (back, front))
        surfaces.append(wall((left, front), (right, front), 0, HEIGHT_M, paint.plaster, DENSITY))
        for i, (at, w, h) in enumerate(POSTERS_M):
            a, b = (x + at, front - 0.03), (x + at + w, front - 0.03)
            poster = wall(a, b, 1.95 - h, 1.95, paint.picture, 1.2 * DENSITY)
            surfaces.append(replace(poster, texture=TEXTURES_FROM + i))
        surfaces += along_wall(rng, np.array([left, front]), np.array([right, front]), has_door=False, tall=False)
        surfaces += _furnished(rng, np.array([right, back]), np.array([left, back]))
        if n == 0:
            surfaces += _furnished(rng, np.array([left, back]), np.array([left, front]))
        else:
            surfaces += _furnished(rng, np.array([right, front]), np.array([right, back]))
    # Between the rooms a wall with an opening; each side of it is seen from its own room.
    opening = (-1.0 - OPENING_M / 2, -1.0 + OPENING_M / 2)
    for begin, end in ((-deep / 2, opening[0]), (opening[1], deep / 2)):
        surfaces.append(wall((0, end), (0, begin), 0, HEIGHT_M, paint.plaster, DENSITY))
        surfaces.append(wall((0, begin), (0, end), 0, HEIGHT_M, paint.plaster, DENSITY))
    rng = np.random.default_rng([seed, 0x90A])
    along = np.linspace(-wide + 1.0, wide - 1.0, 9)
    points = np.stack([along, -1.0 + np.r_[rng.uniform(-0.35, 0.35, 4), 0.0, rng.uniform(-0.35, 0.35, 4)]], 1)
    return Scene(tuple(surfaces), background=128, seed=seed), Way(rng, points, SLIDE_M_S, yaw_rad=0.0)


def _corridor() -> list[Surface]:
    """Return the walls, floor and ceiling of a corridor along z, open at both ends, with doors and pictures."""
    width, length = CORRIDOR_M
    half = width / 2
    surfaces = _floor_and_ceiling((-half, half), (0.0, length))
    for side in (-1.0, 1.0):
        x, out = side * half, side * (half - 0.03)
        ends = ((x, 0.0), (x, length)) if side < 0 else ((x, length), (x, 0.0))
        surfaces.append(wall(*ends, 0, HEIGHT_M, paint.plaster, DENSITY))
        for z in np.arange(0.8, length - 1.0, 2.4) + (0.0 if side < 0 else 1.1):
            doorway, frame = (z, z + 0.95), (z + 1.25, z + 2.05)
            for (a, b), (low, high), material in (
                (doorway, (0.0, 2.1), paint.door),
                (frame, (1.2, 1.9), paint.picture),
            ):
                if b < length - 0.1:
                    near, far = (a, b) if side < 0 else (b, a)
                    surfaces.append(wall((out, near), (out, far), low, high, material, 1.2 * DENSITY))
    return surfaces


def _furnished(rng: np.random.Generator, left: FloatArray, right: FloatArray) -> list[Surface]:
    """Return a wall with what stands and hangs there."""
    return [wall(left, right, 0, HEIGHT_M, paint.plaster, DENSITY), *along_wall(rng, left, right, has_door=False)]


def _floor_and_ceiling(x_m: tuple[float, float], z_m: tuple[float, float]) -> list[Surface]:
    """Return both, between two x and two z."""
    side_s, depth = np.array([x_m[1] - x_m[0], 0, 0]), z_m[1] - z_m[0]
    floor = Surface(np.array([x_m[0], 0, z_m[1]]), side_s, np.array([0, 0, -depth]), paint.boards, 200, 0.9)
    above = np.array([x_m[0], -HEIGHT_M, z_m[0]])
    return [floor, Surface(above, side_s, np.array([0, 0, depth]), paint.ceiling, 110, 0.85)]


def _moved(surface: Surface, yaw_rad: float, shift: FloatArray) -> Surface:
    """Return a surface turned about the world's vertical and moved."""
    R = pose(np.zeros(3), yaw_rad, 0.0, 0.0)[:3, :3]
    return replace(surface, origin=R @ surface.origin + shift, side_s=R @ surface.side_s, side_t=R @ surface.side_t)


TWINS = {"corridors": make_corridors, "posters": make_posters}
"""By the name of the scene: makes a world, and the way through it, of a seed."""
