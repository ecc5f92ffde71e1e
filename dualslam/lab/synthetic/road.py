"""The winding road of the street scene: its centre line, and the ground around it with everything that lies on it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.interpolate import CubicSpline

from dualslam.core.types import FloatArray
from dualslam.lab.synthetic.painter import Painter

ROAD_HALF_WIDTH_M = 3.6
PAVEMENT_END_M = 6.2
_STEP_M = 6.0


class Road:
    """A planar curve of bends and straights, by arc length.

    Parameters
    ----------
    rng : numpy Generator
    length_m : float
        It is defined from 0 to here.
    """

    def __init__(self, rng: np.random.Generator, length_m: float) -> None:
        n = int(np.ceil(length_m / _STEP_M)) + 2
        # The heading stays within 65 degrees of the first, so the road cannot meet itself; within that, long bends.
        heading = np.zeros(n)
        i, current = 4, 0.0
        while i < n:
            target = float(rng.uniform(0.35, 1.13)) * (
                -1.0 if current > 0 else 1.0 if current < 0 else rng.choice((-1, 1))
            )
            bend = max(3, round(abs(target - current) * float(rng.uniform(28, 55)) / _STEP_M))
            ramp = 0.5 - 0.5 * np.cos(np.linspace(0, np.pi, bend + 1))[1:]
            stop = min(n, i + bend)
            heading[i:stop] = current + (target - current) * ramp[: stop - i]
            straight = int(rng.integers(2, 8))
            heading[stop : stop + straight] = target
            i, current = stop + straight, target
        middle = (heading[1:] + heading[:-1]) / 2
        steps = _STEP_M * np.stack([np.sin(middle), np.cos(middle)], 1)
        knots = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, 0)])
        self._spline = CubicSpline(np.arange(n) * _STEP_M, knots)
        self.length_m = length_m

    def centre(self, s_m: FloatArray | float) -> FloatArray:
        """Return (..., 2) world (x, z) at arc length `s_m`."""
        return np.asarray(self._spline(s_m))

    def heading(self, s_m: FloatArray | float) -> FloatArray:
        """Return the direction in radians, 0 along z, growing towards x."""
        slope = np.asarray(self._spline(s_m, 1))
        return np.asarray(np.arctan2(slope[..., 0], slope[..., 1]))

    def beside(self, s_m: FloatArray | float, lateral_m: FloatArray | float) -> FloatArray:
        """Return world (x, z) at `s_m`, `lateral_m` to the right of the centre line."""
        heading = self.heading(s_m)
        right = np.stack([np.cos(heading), -np.sin(heading)], -1)
        return np.asarray(self.centre(s_m) + right * np.asarray(lateral_m)[..., None])


@dataclass(frozen=True, slots=True)
class Decal:
    """Something flat on the ground: `kind` is patch, cover, shadow, crack or litter; `seed` fixes its shape."""

    kind: str
    x: float
    z: float
    radius_m: float
    seed: int


@dataclass(frozen=True, slots=True, eq=False)
class GroundTile:
    """Paints a square of the ground: asphalt with markings, kerbs, pavement slabs, grass, and the decals that touch it.

    Attributes
    ----------
    line : (N, 2) float64
        The road's centre line around the tile, world (x, z).
    half_width_m : float
        Of the asphalt.
    decals : tuple of Decal
    x_m, z_m : float
        World position of the tile's top-left corner: x grows to the right of the texture, z upwards.
    """

    line: FloatArray
    decals: tuple[Decal, ...]
    x_m: float
    z_m: float

    def __call__(self, p: Painter) -> None:
        """Paint the piece."""
        grain = p.anchored_noise(round(self.x_m * p.px_per_m), round(-self.z_m * p.px_per_m))
        # Stones and specks of a few centimetres, which fractal noise alone lacks.
        grain += 0.9 * p.rng.standard_normal(p.image.shape, dtype=np.float32)
        clouds = p.anchored_noise(round(self.x_m * p.px_per_m), round(-self.z_m * p.px_per_m), smooth=True)
        local = (self.line - (self.x_m, self.z_m)) * (1, -1)
        p.image[:] = 92 + 15 * grain + 12 * clouds
        p.leaves(900, (0.03, 0.09), (20, 170))
        zone = np.zeros(p.image.shape, np.uint8)
        for label, half_width in ((1, PAVEMENT_END_M), (2, ROAD_HALF_WIDTH_M + 0.2), (3, ROAD_HALF_WIDTH_M)):
            cv2.polylines(zone, [np.round(local * p.px_per_m).astype(np.int32)], False, label, p.px(2 * half_width)[0])
        soil = p.image.copy()
        p.image[:] = 150 + 7 * grain + 9 * clouds
        p.bricks(0.62, 0.4, 9, -45)
        slabs = p.image.copy()
        asphalt = 104 + 8 * grain + 9 * clouds
        p.image[:] = np.choose(zone, (soil, slabs, 175 + 8 * grain, asphalt))
        self._markings(p)
        for decal in self.decals:
            _draw_decal(p, decal, decal.x - self.x_m, self.z_m - decal.z)

    def _markings(self, p: Painter) -> None:
        """Dashes along the middle, gutters along the kerbs. Dashes go by the line's own spacing of half a metre."""
        local = (self.line - (self.x_m, self.z_m)) * (1, -1)
        # The parts are counted from world positions, so that neighbouring tiles agree.
        along = np.round(self.line[:, 1] / 4.5).astype(np.int64) % 2 == 0
        for start, stop in zip(*_runs(along), strict=True):
            if stop - start > 2:
                p.line(local[start:stop], 215, 0.13)
        tangent = np.gradient(local, axis=0)
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], 1) / np.linalg.norm(tangent, axis=1)[:, None]
        for side in (-1, 1):
            p.line(local + normal * side * (ROAD_HALF_WIDTH_M - 0.05), 55, 0.07)
            p.line(local + normal * side * (ROAD_HALF_WIDTH_M + 0.22), 60, 0.05)


def _runs(flags: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and past-the-last positions of the runs of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return edges[::2], edges[1::2]


def _draw_decal(p: Painter, decal: Decal, x: float, y: float) -> None:
    """Draw a decal centred on (x, y) of the canvas; it may reach over the canvas' edges."""
    rng = np.random.default_rng(decal.seed)
    r = decal.radius_m
    if decal.kind == "cover":
        p.disc(x, y, r, 60)
        p.disc(x, y, r * 0.85, 110)
        for k in range(-3, 4):
            half = r * 0.8 * np.sqrt(1 - (k / 4) ** 2)
            p.line(np.array([[x - half, y + k * r / 4], [x + half, y + k * r / 4]]), 45, 0.03)
        return
    if decal.kind == "crack":
        points = np.cumsum(rng.normal(0, r / 4, (14, 2)), 0) + (x, y)
        p.line(points, float(rng.uniform(20, 60)), float(rng.choice((0.0, 0.05))))
        return
    if decal.kind == "litter":
        for _ in range(9):
            corner = rng.normal(0, r, 2) + (x, y)
            quad = corner + rng.normal(0, 0.07, (4, 2))
            cv2.fillConvexPoly(p.image, np.round(quad * p.px_per_m).astype(np.int32), float(rng.uniform(20, 250)))
        return
    mask = np.zeros(p.image.shape, np.uint8)
    angles = np.sort(rng.uniform(0, 2 * np.pi, 4 if decal.kind == "patch" else 14))
    reach = r * rng.uniform(0.75, 1.0, len(angles))[:, None]
    outline = np.stack([np.cos(angles), np.sin(angles)], 1) * reach + (x, y)
    cv2.fillPoly(mask, [np.round(outline * p.px_per_m).astype(np.int32)], 1)
    if decal.kind == "patch":
        p.image[mask > 0] += float(rng.uniform(-35, 25))
    else:
        soft = cv2.blur(mask.astype(np.float32), (5, 5))
        p.image *= 1 - np.float32(rng.uniform(0.35, 0.6)) * soft
