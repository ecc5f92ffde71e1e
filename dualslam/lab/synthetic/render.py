"""A renderer of textured rectangles in NumPy: exact visibility per pixel, smooth textures, tens of frames a second.

Everything that is needed per pixel is affine in (u, v): let ``X_cam = s * side_s + t * side_t + origin``. Then ``s /
z``, ``t / z`` and ``1 / z`` are the rows of ``inv([side_s, side_t, origin]) @ inv(K)`` applied to (u, v, 1). So the
outline of a rectangle is four affine comparisons, occlusion is a comparison of ``1 / z``, and the texture is one warp.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dualslam.core.types import FloatArray
from dualslam.lab.synthetic.surfaces import Scene, TextureStore

# Three affine forms (a, b, c), each a * u + b * v + c: s/z, t/z, 1/z. Plain floats: per surface, arrays cost more.
Planes = list[list[float]]
F32Image = NDArray[np.float32]
U8Image = NDArray[np.uint8]

_NEAR_M = 0.05
_FAR_M = 400.0
# A warp uses one texture level, so a surface is warped in bands of depth whose far end is this much further.
_BAND_RATIO = 1.5
# Below this many pixels across, relief is not drawn: it costs more than it shows.
_MIN_SIZE_PX = 1.0
# Most surfaces of a street are hidden. Every so many surfaces (more seldom, as less changes) the depth buffer is
# reduced to cells. Surfaces behind all the cells that they touch are left out.
_CELL_PX = 16
_REFRESH_AT = (24, 80, 200, 500)


@dataclass(frozen=True, slots=True, eq=False)
class _Candidates:
    """Surfaces that may be in view, nearest first.

    ``index`` (N,) in the scene. ``planes`` (N, 3, 3): the affine forms of s/z, t/z, 1/z over (u, v, 1). s and t are in
    [0, 1] on the surface. ``bounds`` (N, 4) first and past-the-last pixel: u0, v0, u1, v1; ``nearest`` (N,) the largest
    1/z.
    """

    index: NDArray[np.int64]
    planes: FloatArray
    bounds: NDArray[np.int64]
    nearest: FloatArray


class Renderer:
    """Looks at a scene through a pinhole camera.

    Parameters
    ----------
    scene : Scene
    K : (3, 3) float64
        Intrinsics, pixels.
    width, height : int
        Image size, pixels.
    detail : float
        Factor on the textures' resolution.
    supersampling : float
        Images are rendered this much larger and averaged down, which smooths the silhouettes.
    """

    def __init__(
        self, scene: Scene, K: FloatArray, width: int, height: int, detail: float = 1.0, supersampling: float = 1.0
    ) -> None:
        self._scene = scene
        self._K = np.asarray(K, np.float64)
        self._size = (width, height)
        self._textures = TextureStore(scene, detail)
        self._supersampling = supersampling
        surfaces = scene.surfaces
        self._origin = np.array([s.origin for s in surfaces])
        self._side_s = np.array([s.side_s for s in surfaces])
        self._side_t = np.array([s.side_t for s in surfaces])
        self._middle = self._origin + (self._side_s + self._side_t) / 2
        self._radius = np.linalg.norm(self._side_s + self._side_t, axis=1) / 2
        self._two_sided = np.array([s.two_sided for s in surfaces])
        self._infinite = np.array([s.infinite for s in surfaces])
        self._cutout = np.array([s.cutout for s in surfaces])

    def image(self, T_world_cam: FloatArray) -> U8Image:
        """Render the grey image (height, width) seen from `T_world_cam` (4, 4): no lens, no sensor."""
        width, height = self._size
        ss = self._supersampling
        if ss == 1:
            return self._draw(T_world_cam, self._K, width, height, True)[0]
        big_width, big_height = round(width * ss), round(height * ss)
        S = np.array([[big_width / width, 0, 0], [0, big_height / height, 0], [0, 0, 1.0]])
        half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # (0, 0) is the centre of the top-left pixel
        K_big = np.linalg.inv(half) @ S @ half @ self._K
        big, _ = self._draw(T_world_cam, K_big, big_width, big_height, True)
        return np.asarray(cv2.resize(big, (width, height), interpolation=cv2.INTER_AREA), np.uint8)

    def depth(self, T_world_cam: FloatArray) -> F32Image:
        """Return z in the camera's frame at each pixel's centre (height, width), metres, inf where nothing is hit."""
        _, inverse = self._draw(T_world_cam, self._K, *self._size, False)
        with np.errstate(divide="ignore"):
            return np.float32(1) / inverse

    def _draw(
        self, T_world_cam: FloatArray, K: FloatArray, width: int, height: int, shaded: bool
    ) -> tuple[U8Image, F32Image]:
        """Return the grey image and the inverse depth (0 where nothing is hit)."""
        image = np.full((height, width), self._scene.background, np.uint8)
        # Whole cells; what is beyond the image counts as covered.
        whole = np.full((-(-height // _CELL_PX) * _CELL_PX, -(-width // _CELL_PX) * _CELL_PX), np.inf, np.float32)
        inverse = whole[:height, :width]
        inverse[:] = 0
        u, v = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)
        near = self._candidates(T_world_cam, K, width, height, infinite=False)
        hidden_beyond = np.zeros((1, 1), np.float32)
        planes_of, bounds_of, nearest_of = near.planes.tolist(), near.bounds.tolist(), near.nearest.tolist()
        cells_of = (
            np.stack([near.bounds[:, :2] // _CELL_PX, -(-near.bounds[:, 2:] // _CELL_PX)], 1).reshape(-1, 4).tolist()
        )
        for row, index in enumerate(near.index.tolist()):
            if row in _REFRESH_AT or row % _REFRESH_AT[-1] == 0:
                hidden_beyond = _coarse_minimum(whole)
            x0, y0, x1, y1 = cells_of[row]
            if hidden_beyond[y0:y1, x0:x1].min(initial=np.inf) < nearest_of[row]:
                self._draw_surface(index, planes_of[row], bounds_of[row], u, v, image, inverse, shaded)
        if shaded:
            # The horizon goes behind everything, on a depth buffer of its own.
            behind = np.where(inverse > 0, np.float32(np.inf), np.float32(0))
            if not behind.all():
                sky = self._candidates(T_world_cam, K, width, height, infinite=True)
                lists = (sky.index.tolist(), sky.planes.tolist(), sky.bounds.tolist())
                for index, planes, bounds in zip(*lists, strict=True):
                    self._draw_surface(index, planes, bounds, u, v, image, behind, True)
        return image, inverse

    def _candidates(
        self, T_world_cam: FloatArray, K: FloatArray, width: int, height: int, infinite: bool
    ) -> _Candidates:
        """Cull what is behind, beside, seen from the back or too small; compute the rest's affine forms and bounds."""
        R_world_cam = T_world_cam[:3, :3]
        centre = np.zeros(3) if infinite else T_world_cam[:3, 3]
        # First the cheap test, which leaves little of a long street.
        z_middle = self._middle @ R_world_cam[:, 2] - centre @ R_world_cam[:, 2]
        within = (z_middle > -self._radius) & (z_middle < _FAR_M + self._radius)
        chosen = np.flatnonzero((self._infinite == infinite) & within)
        origin = (self._origin[chosen] - centre) @ R_world_cam
        side_s, side_t = self._side_s[chosen] @ R_world_cam, self._side_t[chosen] @ R_world_cam
        ahead = np.einsum("ni,ni->n", np.cross(side_s, side_t), origin)
        area = np.linalg.norm(side_s, axis=1) * np.linalg.norm(side_t, axis=1)
        # Edge-on surfaces have no pixels and no inverse.
        facing = np.where(self._two_sided[chosen], np.abs(ahead), ahead) > 1e-6 * area

        corners = origin[:, None] + np.stack([0 * side_s, side_s, side_s + side_t, side_t], 1)
        homogeneous = corners @ K.T
        x, y, z = homogeneous[..., 0], homogeneous[..., 1], homogeneous[..., 2]
        inside = (z > _NEAR_M).any(1) & (x > -0.5 * z).any(1) & (x < (width - 0.5) * z).any(1)
        inside &= (y > -0.5 * z).any(1) & (y < (height - 0.5) * z).any(1)
        z_min = np.maximum(z.min(1), _NEAR_M)
        size_px = np.linalg.norm(corners[:, 2] - corners[:, 0], axis=1) * K[0, 0] / z_min
        keep = np.flatnonzero(facing & inside & (size_px > _MIN_SIZE_PX))
        keep = keep[np.argsort(z_min[keep], kind="stable")]

        M = np.stack([side_s[keep], side_t[keep], origin[keep]], axis=2)
        planes = np.linalg.inv(M) @ np.linalg.inv(K)
        limit = np.array([width, height])
        bounds = np.empty((len(keep), 4), np.int64)
        crossing = (z[keep] <= _NEAR_M).any(1)
        with np.errstate(divide="ignore", invalid="ignore"):
            uv = homogeneous[keep, :, :2] / z[keep, :, None]
        for row in np.flatnonzero(crossing):
            clipped = _clip_near(homogeneous[keep[row]])
            uv[row] = np.array([clipped.min(0), clipped.max(0)])[[0, 1, 0, 1]]
        uv = np.clip(uv, -1, limit + 1)
        bounds[:, :2] = np.maximum(np.floor(uv.min(1)), 0)
        bounds[:, 2:] = np.minimum(np.ceil(uv.max(1)) + 1, limit)
        return _Candidates(chosen[keep], planes, bounds, 1 / z_min[keep])

    def _draw_surface(
        self,
        index: int,
        planes: Planes,
        bounds: list[int],
        u: F32Image,
        v: F32Image,
        image: U8Image,
        inverse: F32Image,
        shaded: bool,
    ) -> None:
        """Draw one surface where it is nearer than what is there."""
        u0, v0, u1, v1 = bounds
        if u1 <= u0 or v1 <= v0:
            return
        uu, vv = u[u0:u1], v[v0:v1]
        (a0, b0, c0), (a1, b1, c1), (a2, b2, c2) = planes
        own = (np.float32(a2) * uu)[None, :] + (np.float32(b2) * vv + np.float32(c2))[:, None]
        buffer = inverse[v0:v1, u0:u1]
        visible = own > buffer
        # Inside the outline: 0 <= s <= 1 and 0 <= t <= 1, multiplied by 1/z.
        for a, b, c in ((a0, b0, c0), (a2 - a0, b2 - b0, c2 - c0), (a1, b1, c1), (a2 - a1, b2 - b1, c2 - c1)):
            if min(a * u0, a * (u1 - 1)) + min(b * v0, b * (v1 - 1)) + c < 0:
                along_u, along_v = np.float32(a) * uu, np.float32(b) * vv + np.float32(c)
                visible &= along_u[None, :] >= -along_v[:, None]
        mask = visible.view(np.uint8)
        x, y, w, h = cv2.boundingRect(mask)
        if w == 0:
            return
        mask, own = mask[y : y + h, x : x + w], own[y : y + h, x : x + w]
        if not shaded and not self._cutout[index]:
            cv2.copyTo(own, mask, buffer[y : y + h, x : x + w])
            return
        self._shade(index, planes, (u0 + x, v0 + y, w, h), mask, own, image, inverse)

    def _shade(
        self,
        index: int,
        planes: Planes,
        rect: tuple[int, int, int, int],
        mask: U8Image,
        own: F32Image,
        image: U8Image,
        inverse: F32Image,
    ) -> None:
        """Write a surface's grey levels and inverse depth where `mask` is set, band of depth by band of depth."""
        u0, v0, w, h = rect
        texture = self._textures.get(index)
        a, b, c = planes[2]
        at_corners = [a * x + b * y + c for x in (u0, u0 + w - 1) for y in (v0, v0 + h - 1)]
        nearest, furthest = min(max(at_corners), 1 / _NEAR_M), max(min(at_corners), 1e-4)
        # Bands at fixed depths: they stay where they are in the image while the camera moves along the surface.
        first, last = (math.floor(math.log(d, _BAND_RATIO)) for d in (furthest, nearest))
        for band in range(first, last + 1):
            part, (x, y, bw, bh) = mask, (0, 0, w, h)
            if first != last:
                low = _BAND_RATIO**band if band > first else 0.0
                high = _BAND_RATIO ** (band + 1) if band < last else 1e9
                x, y, bw, bh = _strip(planes[2], rect, low, high)
                if bw <= 0 or bh <= 0:
                    continue
                band_mask = np.asarray(cv2.inRange(own[y : y + bh, x : x + bw], low, high), np.uint8)
                part = band_mask & mask[y : y + bh, x : x + bw]
                dx, dy, bw, bh = cv2.boundingRect(part)
                if bw == 0:
                    continue
                part = part[dy : dy + bh, dx : dx + bw]
                x, y = x + dx, y + dy
            part_rect = (u0 + x, v0 + y, bw, bh)
            target = np.s_[v0 + y : v0 + y + bh, u0 + x : u0 + x + bw]
            levels = _levels(planes, part_rect, texture.grey.level(0, 0).shape)
            if texture.alpha is not None:
                part = part & (_warp(texture.alpha.level(*levels), planes, part_rect) >> np.uint8(7))
            grey = _warp(texture.grey.level(*levels), planes, part_rect)
            cv2.copyTo(grey, part, image[target])
            cv2.copyTo(own[y : y + bh, x : x + bw], part, inverse[target])


def _coarse_minimum(inverse: F32Image) -> F32Image:
    """Return the smallest inverse depth of each cell of `_CELL_PX` x `_CELL_PX` pixels (the size is a multiple)."""
    rows, cols = inverse.shape[0] // _CELL_PX, inverse.shape[1] // _CELL_PX
    # Rows first: contiguous, and what remains for the slower step is small.
    by_rows = inverse.reshape(rows, _CELL_PX, -1).min(1)
    return np.asarray(by_rows.reshape(rows, cols, _CELL_PX).min(2))


def _clip_near(corners: FloatArray) -> FloatArray:
    """Clip a polygon of homogeneous pixels (4, 3) at the near plane and return its (N, 2) pixels."""
    kept = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if a[2] > _NEAR_M:
            kept.append(a[:2] / a[2])
        if (a[2] > _NEAR_M) != (b[2] > _NEAR_M):
            crossing = a + (b - a) * (_NEAR_M - a[2]) / (b[2] - a[2])
            kept.append(crossing[:2] / _NEAR_M)
    return np.array(kept)


def _strip(inv_z: list[float], rect: tuple[int, int, int, int], low: float, high: float) -> tuple[int, int, int, int]:
    """Return (x, y, w, h) within `rect` that holds all of its pixels with ``low <= 1/z <= high`` (a strip)."""
    spans = []
    for axis in (0, 1):
        slope, across, n = inv_z[axis], inv_z[1 - axis], rect[2 + axis]
        if abs(slope) < 1e-12:
            spans.append((0, n))
            continue
        # Along this axis 1/z = slope * x + rest, with rest anywhere between its values at the two ends.
        start, stop = rect[1 - axis], rect[1 - axis] + rect[3 - axis] - 1
        rests = [across * end + slope * rect[axis] + inv_z[2] for end in (start, stop)]
        limits = [(value - rest) / slope for value in (low, high) for rest in rests]
        first, last = max(min(limits), 0.0), min(max(limits), n - 1.0)
        spans.append((math.floor(first), math.ceil(last) + 1))
    (x0, x1), (y0, y1) = spans
    return x0, y0, x1 - x0, y1 - y0


def _levels(planes: Planes, rect: tuple[int, int, int, int], shape: tuple[int, ...]) -> tuple[int, int]:
    """Return the texture level along s and t at which a pixel in the middle of `rect` covers about one texel."""
    u, v = rect[0] + (rect[2] - 1) / 2, rect[1] + (rect[3] - 1) / 2
    a, b, c = planes[2]
    inv_z = a * u + b * v + c
    levels = []
    for (p, q, r), n in ((planes[0], shape[1]), (planes[1], shape[0])):
        # The gradient of (p u + q v + r) / (a u + b v + c).
        value = (p * u + q * v + r) / inv_z
        texels_per_px = math.hypot(p - value * a, q - value * b) / inv_z * n
        # A level is used from 0.7 to 1.4 texels per pixel: bilinear sampling is alias-free enough, and not too soft.
        levels.append(max(round(math.log2(max(texels_per_px, 1e-6))), 0))
    return levels[0], levels[1]


def _warp(level: U8Image, planes: Planes, rect: tuple[int, int, int, int]) -> U8Image:
    """Sample a texture level at the pixels of `rect`."""
    u0, v0, w, h = rect
    a, b, c = planes[2]
    c += a * u0 + b * v0
    rows = []
    for (p, q, r), n in ((planes[0], level.shape[1]), (planes[1], level.shape[0])):
        # Texture coordinates in [0, 1] to texels, (0, 0) being the centre of the first one.
        r += p * u0 + q * v0
        rows.append([n * p - 0.5 * a, n * q - 0.5 * b, n * r - 0.5 * c])
    H_texel_px = np.array([*rows, [a, b, c]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    grey = cv2.warpPerspective(level, H_texel_px, (w, h), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(grey, np.uint8)
