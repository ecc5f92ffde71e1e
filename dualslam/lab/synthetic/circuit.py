"""Worlds to come back to, and one that only seems to: a block driven round and round, a figure of eight, a terrace."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import KDTree

from dualslam.core.types import FloatArray
from dualslam.lab.synthetic.road import Road
from dualslam.lab.synthetic.street import BEHIND_M, back_row, furniture, ground, horizon, houses
from dualslam.lab.synthetic.surfaces import Scene, Surface

BLOCK_RADIUS_M = (34.0, 24.0)
"""Half the size of the block, along x and z: room for two rows of houses back to back."""
EIGHT_RADIUS_M = 30.0
CLEAR_M = 2.3
"""About the road's middle nothing stands: a parked car's side is farther away, the camera's lane nearer."""
MODULE_M = 28.0
"""Of the terrace: after so many metres all houses, trees and cars come again."""
TEXTURES_FROM = 1_000_000


class ClosedRoad(Road):
    """A road that comes back to its beginning; its arc length goes on over any number of laps.

    Parameters
    ----------
    points : (N, 2)
        World (x, z) along one lap, densely, without the first again.
    """

    def __init__(self, points: FloatArray) -> None:
        closed = np.concatenate([points, points[:1]])
        s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
        self._spline = CubicSpline(s, closed, bc_type="periodic")
        self.length_m = float(s[-1])

    def centre(self, s_m: FloatArray | float) -> FloatArray:
        """Return (..., 2) world (x, z) at arc length `s_m`, of any lap."""
        return np.asarray(self._spline(np.mod(s_m, self.length_m)))

    def heading(self, s_m: FloatArray | float) -> FloatArray:
        """Return the direction in radians, 0 along z, growing towards x."""
        slope = np.asarray(self._spline(np.mod(s_m, self.length_m), 1))
        return np.asarray(np.arctan2(slope[..., 0], slope[..., 1]))


class StraightRoad(Road):
    """A road along z."""

    def __init__(self, length_m: float) -> None:
        self._spline = CubicSpline([0.0, length_m], [[0.0, 0.0], [0.0, length_m]])
        self.length_m = length_m


def make_circuit(seed: int) -> tuple[Scene, Road]:
    """Build a block of houses with a road around it."""
    a = np.linspace(0, 2 * np.pi, 240, endpoint=False)
    # A rounded rectangle: a superellipse of the fourth degree.
    c, s = np.cos(a), np.sin(a)
    r = 1 / (c**4 + s**4) ** 0.25
    return _lined(seed, ClosedRoad(np.stack([BLOCK_RADIUS_M[0] * r * c, BLOCK_RADIUS_M[1] * r * s], 1)), 0xC1C)


def make_eight(seed: int) -> tuple[Scene, Road]:
    """Build a road that crosses itself: two rings, one driven to the right and one to the left."""
    a = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    points = EIGHT_RADIUS_M * np.stack([2 * np.sin(a), 1.3 * np.sin(2 * a)], 1)
    return _lined(seed, ClosedRoad(points), 0x8E8)


def make_terrace(seed: int, length_m: float) -> tuple[Scene, Road]:
    """Build a straight street whose houses, trees and cars repeat every `MODULE_M`, textures and all."""
    road = StraightRoad(length_m + 170.0)
    surfaces = list(ground(np.random.default_rng([seed, 0x7E]), road))
    module: list[Surface] = []
    rng = np.random.default_rng([seed, 0x7E77])
    for side in (-1.0, 1.0):
        part = StraightRoad(MODULE_M + BEHIND_M)
        module += houses(rng, part, side) + furniture(rng, part, side)
    module = [replace(s, texture=TEXTURES_FROM + i) for i, s in enumerate(module)]
    for n in range(int(road.length_m / MODULE_M)):
        ahead = np.array([0.0, 0.0, n * MODULE_M])
        surfaces += [replace(s, origin=s.origin + ahead) for s in module]
    return Scene((*surfaces, *horizon()), background=240, seed=seed), road


def _lined(seed: int, road: ClosedRoad, word: int) -> tuple[Scene, Road]:
    """Build up both sides of a closed road, where there is room."""
    rng = np.random.default_rng([seed, word])
    built: list[Surface] = []
    kinds: tuple[Callable[..., list[Surface]], ...] = (houses, furniture)
    for side in (-1.0, 1.0):
        for kind in kinds:
            built += kind(rng, road, side)
    # Only outwards: inside, what stands so far off the road stands on its other side.
    line = road.centre(np.arange(0, road.length_m, 0.5))
    area = float(np.sum(line[:-1, 0] * line[1:, 1] - line[1:, 0] * line[:-1, 1]))
    built += back_row(rng, road, 1.0 if area > 0 else -1.0)
    near = KDTree(line)
    built = [surface for surface in built if _is_clear(surface, near)]
    return Scene((*ground(rng, road), *built, *horizon()), background=240, seed=seed), road


def _is_clear(surface: Surface, line: KDTree) -> bool:
    """Whether a surface leaves the road free."""
    steps = np.linspace(0, 1, 7)
    s, t = np.meshgrid(steps, steps)
    points = surface.origin + s[..., None] * surface.side_s + t[..., None] * surface.side_t
    foot = points[..., [0, 2]].reshape(-1, 2)
    return bool(np.min(line.query(foot)[0]) > CLEAR_M)
