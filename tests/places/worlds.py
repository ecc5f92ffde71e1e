"""Small worlds to come back to: a lap whose end overlaps its beginning, and the same with everything there twice."""

from __future__ import annotations

from functools import cache

import numpy as np

from dualslam.core.geometry import se3
from dualslam.core.types import FloatArray
from dualslam.system.system import System
from dualslam.testing.point_world import PointWorld, system_in

N_LAP, N = 110, 140
RADIUS_M = 5.0


def ring(n: int, n_lap: int = N_LAP) -> FloatArray:
    """A camera on a circle that looks outwards."""
    angle = 2 * np.pi * np.arange(n) / n_lap
    out = np.column_stack([np.cos(angle), 0 * angle, np.sin(angle)])
    down = np.broadcast_to([0.0, 1.0, 0.0], out.shape)
    return se3.from_parts(np.stack([np.cross(down, out), down, out], axis=2), RADIUS_M * out)


def wall(seed: int = 0, n: int = 2200) -> FloatArray:
    """Points all around the circle."""
    rng = np.random.default_rng(seed)
    a = rng.uniform(0, 2 * np.pi, n)
    r = RADIUS_M + rng.uniform(3.0, 8.0, n)
    return np.column_stack([r * np.cos(a), rng.uniform(-4, 4, n), r * np.sin(a)])


def lap(n: int = N, covered: frozenset[int] = frozenset()) -> PointWorld:
    return PointWorld(wall(), ring(n), covered=covered)


def twice_the_same(n: int = N) -> PointWorld:
    """The far half of the ring looks like the near half, to the last descriptor."""
    half = wall(n=1100)
    half = half[half[:, 2] > 0]
    there = half @ np.diag([-1.0, 1.0, -1.0])  # turned by half a circle
    world = PointWorld(np.concatenate([half, there]), ring(n))
    world.descriptors[len(half) :] = world.descriptors[: len(half)]
    return world


def run(world: PointWorld, n: int | None = None, **settings: object) -> System:
    system = system_in(world, **settings)
    for frame in world.frames()[:n]:
        system.step(frame)
    return system


@cache
def driven_lap() -> System:
    """The lap in one map that knows nothing of its loop."""
    return run(lap(), loops={"enabled": False})
