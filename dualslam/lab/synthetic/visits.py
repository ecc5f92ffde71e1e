"""The same place on another day: other light, other parked cars; or driven the other way round."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby

import numpy as np

from dualslam.core.types import FloatArray
from dualslam.lab.synthetic.road import Road
from dualslam.lab.synthetic.surfaces import SUN, Scene, Surface, light_on

GONE = 0.5
"""Share of the parked cars that are not there any more."""
DULLER = (0.75, 1.1)
"""How bright a later hour is, from and to: an overcast one, or a little more sun."""


def at_another_hour(scene: Scene, visit: int) -> Scene:
    """Return a scene as it looks on a later visit: what stands there for good stands where it stood, painted the same.

    Half of the parked cars have left, the others are others; the sun has moved on, and is as bright as it is today.

    Parameters
    ----------
    scene : Scene
    visit : int
        Each has an hour of its own; 0 is the scene itself.
    """
    if visit == 0:
        return scene
    rng = np.random.default_rng([scene.seed, 0x517, visit])
    angle = float(rng.uniform(0.4, 1.2)) * np.pi  # a quarter to half of the way round
    c, s = np.cos(angle), np.sin(angle)
    sun, level = np.array([[c, -s], [s, c]]) @ SUN, float(rng.uniform(*DULLER))
    numbered = [replace(f, texture=i if f.texture is None else f.texture) for i, f in enumerate(scene.surfaces)]
    there: list[Surface] = []
    for parked, group in groupby(numbered, lambda surface: surface.parked):
        surfaces = list(group)
        if parked and rng.random() < GONE:
            continue
        for surface in surfaces:
            other = (visit * len(numbered) if parked else 0) + (surface.texture or 0)
            light = light_on(surface.side_s, sun) / light_on(surface.side_s, SUN) if _is_wall(surface) else 1.0
            there.append(replace(surface, texture=other, shade=surface.shade * level * light))
    return Scene(tuple(there), round(scene.background * min(level, 1.0)), scene.seed)


def _is_wall(surface: Surface) -> bool:
    """Whether the light that falls on a surface depends on where the sun stands."""
    upright = abs(surface.side_t[1]) > 0.9 * float(np.linalg.norm(surface.side_t))
    return upright and not surface.two_sided and not surface.infinite


class OtherWay(Road):
    """A closed road, driven the other way round."""

    def __init__(self, road: Road) -> None:
        self._road = road
        self.length_m = road.length_m

    def centre(self, s_m: FloatArray | float) -> FloatArray:
        """Return (..., 2) world (x, z) at arc length `s_m`."""
        return self._road.centre(-np.asarray(s_m, float))

    def heading(self, s_m: FloatArray | float) -> FloatArray:
        """Return the direction in radians, 0 along z, growing towards x."""
        return np.asarray(self._road.heading(-np.asarray(s_m, float)) + np.pi)
