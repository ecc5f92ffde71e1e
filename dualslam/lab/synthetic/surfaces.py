"""Surfaces of a synthetic world: textured rectangles, pictures made on first sight, and the scene they form.

World frame of all scenes: metres, x right, y down, z forward, the ground (or floor) at y = 0; heights are negative y.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualslam.core.types import FloatArray
from dualslam.lab.synthetic.painter import NoiseBank, Painter

SUN = np.array([0.6, 0.8])
"""(x, z) along which the light comes in."""
MAX_BYTES = 120_000_000
"""Of the finest levels that are kept; the coarser ones add up to three times as much."""
Material = Callable[[Painter], None]
U8Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A flat textured rectangle.

    Attributes
    ----------
    origin : (3,) float64
        World position of the texture's top-left corner, metres.
    side_s, side_t : (3,) float64
        World vectors along the texture's width (to its right) and its height (downwards), metres, orthogonal.
    material : callable
        Paints the texture on a `Painter`.
    texels_per_m : float
        Resolution of the texture's finest level.
    shade : float
        Brightness factor: the light that falls on the surface.
    cutout : bool
        True where the texture has holes (leaves, fences, round signs).
    two_sided : bool
        True where it is seen from behind too; otherwise only against ``cross(side_s, side_t)``.
    infinite : bool
        True for the sky and what lies on the horizon: moves with the camera, has no depth.
    texture : int, optional
        Number of the picture, the same for surfaces that look alike; by default each has its own.
    parked : bool
        True where it is part of a car, which may have left by the next visit.
    """

    origin: FloatArray
    side_s: FloatArray
    side_t: FloatArray
    material: Material
    texels_per_m: float
    shade: float = 1.0
    cutout: bool = False
    two_sided: bool = False
    infinite: bool = False
    texture: int | None = None
    parked: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A world to look at.

    Attributes
    ----------
    surfaces : tuple of Surface
    background : int
        Grey level where no surface is hit.
    seed : int
        From which each surface's texture is drawn, independent of the order in which they come into sight.
    """

    surfaces: tuple[Surface, ...]
    background: int
    seed: int


class RipMap:
    """A texture at all resolutions, width and height halved independently.

    Against a square pyramid this keeps detail on surfaces seen at a grazing angle (roads, facades along a street)
    without aliasing in the foreshortened direction.
    """

    def __init__(self, base: U8Image) -> None:
        self._levels: dict[tuple[int, int], U8Image] = {(0, 0): base}
        self._max_level = (int(np.log2(base.shape[1])), int(np.log2(base.shape[0])))

    def level(self, level_s: int, level_t: int) -> U8Image:
        """Return the texture with its width halved `level_s` times and its height `level_t` times (clamped)."""
        key = (min(max(level_s, 0), self._max_level[0]), min(max(level_t, 0), self._max_level[1]))
        image = self._levels.get(key)
        if image is None:
            # One fixed parent per level: the result does not depend on which levels were asked for before.
            parent = self.level(key[0], key[1] - 1) if key[1] else self.level(key[0] - 1, 0)
            height, width = self._levels[0, 0].shape
            size = (max(1, round(width / 2 ** key[0])), max(1, round(height / 2 ** key[1])))
            image = np.asarray(cv2.resize(parent, size, interpolation=cv2.INTER_AREA), np.uint8)
            self._levels[key] = image
        return image

    @property
    def n_bytes(self) -> int:
        """Size of the finest level; all levels together stay under four times that."""
        return self._levels[0, 0].size


@dataclass(frozen=True, slots=True, eq=False)
class Texture:
    """Grey levels of a surface and, for cut-outs, the opacity."""

    grey: RipMap
    alpha: RipMap | None


class TextureStore:
    """Paints textures when they are first needed and keeps the most recently used ones.

    Parameters
    ----------
    scene : Scene
    detail : float
        Factor on every surface's `texels_per_m`: small images need less.
    """

    def __init__(self, scene: Scene, detail: float = 1.0) -> None:
        self._scene = scene
        self._detail = detail
        self._max_bytes = MAX_BYTES
        self._bank = NoiseBank(scene.seed)
        self._textures: OrderedDict[int, Texture] = OrderedDict()
        self._bytes = 0

    def get(self, index: int) -> Texture:
        """Return the texture of surface `index`, painting it if need be."""
        texture = self._textures.get(index)
        if texture is not None:
            self._textures.move_to_end(index)
            return texture
        texture = self._paint(index)
        self._textures[index] = texture
        self._bytes += texture.grey.n_bytes
        while self._bytes > self._max_bytes and len(self._textures) > 1:
            _, old = self._textures.popitem(last=False)
            self._bytes -= old.grey.n_bytes
        return texture

    def _paint(self, index: int) -> Texture:
        surface = self._scene.surfaces[index]
        rng = np.random.default_rng([self._scene.seed, index if surface.texture is None else surface.texture])
        size_m = (float(np.linalg.norm(surface.side_s)), float(np.linalg.norm(surface.side_t)))
        painter = Painter(rng, self._bank, size_m, surface.texels_per_m * self._detail)
        surface.material(painter)
        alpha = RipMap(painter.alpha) if surface.cutout else None
        return Texture(RipMap(painter.finish(surface.shade)), alpha)


def light_on(side: FloatArray, sun: FloatArray) -> float:
    """Return how much light falls on an upright surface with this side: it depends on which way it looks.

    `sun`: (2,) unit vector (x, z) along which the light comes in.
    """
    normal_in = np.array([-side[2], side[0]]) / max(float(np.hypot(side[0], side[2])), 1e-9)
    return 0.78 + 0.36 * float(normal_in @ sun)


def wall(
    left: ArrayLike,
    right: ArrayLike,
    bottom_m: float,
    top_m: float,
    material: Material,
    texels_per_m: float,
    **more: bool,
) -> Surface:
    """Return an upright rectangle over the ground line from `left` to `right` (x, z), as seen from its front.

    `bottom_m` and `top_m` are heights over the ground.
    """
    left, right = np.asarray(left, np.float64), np.asarray(right, np.float64)
    side = np.array([right[0] - left[0], 0.0, right[1] - left[1]])
    shade = light_on(side, SUN)
    origin = np.array([left[0], -top_m, left[1]])
    return Surface(origin, side, np.array([0.0, top_m - bottom_m, 0.0]), material, texels_per_m, shade, **more)


def box(
    centre: ArrayLike,
    yaw_rad: float,
    size_m: tuple[float, float, float],
    bottom_m: float,
    materials: Sequence[Material | None],
    texels_per_m: float,
) -> list[Surface]:
    """Return the outer faces of an upright box.

    Parameters
    ----------
    centre : (2,)
        World (x, z) of its middle.
    yaw_rad : float
        Turn about the vertical; at zero the length is along x, at pi/2 along -z.
    size_m : (length, width, height)
    bottom_m : float
        Height of its underside over the ground.
    materials : front (length), right side, back, left side, top, underside
        None leaves a face out; missing ones at the end are left out too.
    texels_per_m : float
    """
    length, width, height = size_m
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    along, across = np.array([c, -s]), np.array([s, c])
    middle = np.asarray(centre, np.float64)
    corners = [
        middle + along * a * length / 2 + across * b * width / 2 for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    top_m = bottom_m + height
    faces = []
    for i, material in enumerate(materials[:4]):
        if material is not None:
            faces.append(wall(corners[i], corners[(i + 1) % 4], bottom_m, top_m, material, texels_per_m))
    side_s = np.array([along[0], 0.0, along[1]]) * length
    side_depth = np.array([across[0], 0.0, across[1]]) * width
    if len(materials) > 4 and materials[4] is not None:
        origin = np.array([corners[3][0], -top_m, corners[3][1]])
        faces.append(Surface(origin, side_s, -side_depth, materials[4], texels_per_m, 1.1))
    if len(materials) > 5 and materials[5] is not None:
        origin = np.array([corners[0][0], -bottom_m, corners[0][1]])
        faces.append(Surface(origin, side_s, side_depth, materials[5], texels_per_m, 0.6))
    return faces
